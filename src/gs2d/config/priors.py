"""What a recipe says about depths and normals that are known beforehand. Pure Python; never imports torch."""

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
    """Where known depths come from and how far they are trusted (``training/priors.py``, ``losses/priors.py``).

    Attributes
    ----------
    source : str
        "sparse": points of the reconstruction that found the cameras; "sensor": depth maps in units of the capture
        times a factor; "relative": depth maps of unknown scale and shift, one of each a view; "auto": by what the
        capture has.
    final_factor, decay_steps : float, int
        The weight of the loss falls log-linearly to this share of itself over so many iterations of the run, all
        stages counted: photographs know better in the end.
    opacity : float
        Least rendered alpha of a pixel whose depth is asked.
    noise : float
        Relative error of known depths that is to be expected: below it the loss is quadratic, beyond it linear.
    min_track : int
        Least photographs that a sparse point was found in.
    max_error : float
        px. Largest mean reprojection error of a sparse point.
    unit : float or None
        World units of a value 1 in a sensor's map. None: what fits the sparse points where the capture says which
        photographs show them (COLMAP's scale is arbitrary), else what the capture says, a thousandth for whole
        numbers, or 1.
    space : str
        What relative maps are linear in: "disparity" (1 / depth, larger is nearer) or "depth"; "auto": what fits the
        sparse points better.
    start : bool
        Training starts from places on the maps too: as many as the recipe's ``init_points``.
    align : str
        What scale and shift of a relative map are fitted to: the sparse "points" in it (where they are too few, and in
        captures without any, what is rendered), or always what is "rendered", anew in each iteration.
    """

    source: str = "auto"
    final_factor: float = 0.01
    decay_steps: int = 30_000
    opacity: float = 0.5
    noise: float = 0.05
    min_track: int = 3
    max_error: float = 2.0
    unit: float | None = None
    space: str = "auto"
    align: str = "points"
    start: bool = True

    def weight_at(self, iteration: int) -> float:
        """Share of the weight at an iteration of the run (1-based)."""
        return _decayed(self.final_factor, iteration / self.decay_steps)


@dataclass(frozen=True)
class NormalPrior:
    """How normal maps of the photographs are read, and how far they are trusted.

    Attributes
    ----------
    axes : str
        Of the maps, in the camera's frame: "opencv" (x right, y down, z forward), "opengl" (x right, y up, z back), or
        "auto": in which a surface that is seen faces the camera.
    final_factor, decay_steps : float, int
        As of :class:`DepthPrior`.
    """

    axes: str = "auto"
    final_factor: float = 0.01
    decay_steps: int = 30_000

    def weight_at(self, iteration: int) -> float:
        """Share of the weight at an iteration of the run (1-based)."""
        return _decayed(self.final_factor, iteration / self.decay_steps)


def _decayed(final_factor: float, fraction: float) -> float:
    """From 1 to ``final_factor``, log-linear in [0, 1]."""
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
    opacity = number(f"{at}.opacity", depth.opacity, low=0.0)
    require(opacity < 1, f"{at}.opacity must be below 1, which no rendering reaches, got {opacity}")
    require(number(f"{at}.noise", depth.noise, low=0.0) > 0, f"{at}.noise must be positive, got 0")
    integer(f"{at}.min_track", depth.min_track, low=2)
    require(number(f"{at}.max_error", depth.max_error, low=0.0) > 0, f"{at}.max_error must be positive, got 0")
    if depth.unit is not None:
        require(number(f"{at}.unit", depth.unit, low=0.0) > 0, f"{at}.unit must be positive, got 0")
