"""Settings of the losses on known depths and normals. Pure Python; never imports torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gs2d.config.validate import integer, number, one_of, require

SOURCES = ("auto", "sparse", "sensor", "relative")
SPACES = ("auto", "disparity", "depth")
ALIGNMENTS = ("points", "rendered")
AXES = ("auto", "opencv", "opengl")


@dataclass(frozen=True)
class DepthPrior:
    """Source of known depths, and how much they count (``losses/known_maps.py``, ``losses/prior_formulas.py``)."""

    # "sparse": sparse points of the capture; "sensor": depth maps in units of the capture times a factor; "relative":
    # depth maps with an unknown scale and shift for each view; "auto": sensor maps, relative maps or sparse points,
    # whichever the capture has first
    source: str = "auto"
    # final_factor, decay_steps: the weight of the loss decays log-linearly to this fraction over ``decay_steps``
    # iterations of the run, because the images are more accurate in the end
    final_factor: float = 0.01
    decay_steps: int = 30_000
    min_track: int = 3  # smallest number of images of a sparse point
    max_error: float = 2.0  # px; largest mean reprojection error of a sparse point
    # World units of a value of 1 in a sensor map. None: the unit that fits the sparse points (the scale of COLMAP is
    # arbitrary); without points that of the capture, 0.001 for integers, or 1.
    unit: float | None = None
    # Quantity that relative maps are linear in: "disparity" (1 / depth) or "depth"; "auto": the one that fits the
    # sparse points better.
    space: str = "auto"
    # Scale and shift of a relative map are fitted to its sparse "points", or to the rendered depth if there are too
    # few; "rendered": always to the rendered depth, in each iteration.
    align: str = "points"
    start: bool = True  # whether training also starts from points on the maps, as many as the recipe's ``init_points``

    def weight_at(self, iteration: int) -> float:
        """Return the factor of the weight at an iteration of the run (1-based)."""
        return _decayed(self.final_factor, iteration / self.decay_steps)


@dataclass(frozen=True)
class NormalPrior:
    """Settings of the loss on known normals."""

    # Axes of the maps in the camera frame: "opencv" (x right, y down, z forward), "opengl" (x right, y up, z back) or
    # "auto", those in which normals face the camera.
    axes: str = "auto"
    # final_factor, decay_steps: see :class:`DepthPrior`
    final_factor: float = 0.01
    decay_steps: int = 30_000

    def weight_at(self, iteration: int) -> float:
        """Return the factor of the weight at an iteration of the run (1-based)."""
        return _decayed(self.final_factor, iteration / self.decay_steps)


def _decayed(final_factor: float, fraction: float) -> float:
    """Return a factor that falls log-linearly from 1 to ``final_factor`` for fractions in [0, 1]."""
    return math.exp(min(max(fraction, 0.0), 1.0) * math.log(final_factor))


def check_priors(where: str, depth: DepthPrior | None, normal: NormalPrior | None) -> None:
    """Raise RecipeError for an invalid value."""
    for name, value in (("depth_prior", depth), ("normal_prior", normal)):
        at = f"{where}: {name}"
        if value is None:
            continue
        fraction = number(f"{at}.final_factor", value.final_factor, low=0.0)
        require(0 < fraction <= 1, f"{at}.final_factor must be in (0, 1], got {fraction}")
        integer(f"{at}.decay_steps", value.decay_steps, low=1)
    if normal is not None:
        one_of(f"{where}: normal_prior.axes", normal.axes, AXES)
    if depth is None:
        return
    at = f"{where}: depth_prior"
    one_of(f"{at}.source", depth.source, SOURCES)
    one_of(f"{at}.space", depth.space, SPACES)
    one_of(f"{at}.align", depth.align, ALIGNMENTS)
    integer(f"{at}.min_track", depth.min_track, low=2)
    require(number(f"{at}.max_error", depth.max_error, low=0.0) > 0, f"{at}.max_error must be positive, got 0")
    if depth.unit is not None:
        require(number(f"{at}.unit", depth.unit, low=0.0) > 0, f"{at}.unit must be positive, got 0")
