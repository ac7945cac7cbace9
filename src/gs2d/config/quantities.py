"""Quantities of images and cameras that a recipe learns with the splats. Pure Python; never imports torch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from gs2d.config.registry import Register, Registry
from gs2d.config.validate import integer, number, one_of, require
from gs2d.errors import RecipeError

QUANTITIES: Registry[Any] = Registry(
    "quantity",
    "gs2d.quantities",
    builtin={
        "intrinsics": "gs2d.training.learned.camera_intrinsics",
        "poses": "gs2d.training.learned.camera_pose",
        "vignetting": "gs2d.training.learned.camera_light",
        "exposure": "gs2d.training.learned.image_exposure",
        "response": "gs2d.training.learned.camera_light",
    },
    error=RecipeError,
)
"""Names of learned quantities -> subclasses of ``gs2d.training.learned.quantity.LearnedQuantity``."""


def register_quantity(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers a learned quantity, so that ``Recipe.learned`` can name it.

    Parameters
    ----------
    name : str
        Must not be taken.

    Returns
    -------
    callable
        Decorates a subclass of ``gs2d.training.learned.quantity.LearnedQuantity``. Its constructor takes the settings,
        the scene and the options of the :class:`Quantity`.

    Raises
    ------
    RecipeError
        From the decorator: the name is taken.

    Examples
    --------
    The guide "Extending gs2d" has a whole quantity.

    >>> @gs2d.register_quantity("white-point")  # doctest: +SKIP
    ... class WhitePoint(LearnedQuantity): ...
    >>> recipe = replace(recipe, learned=(gs2d.Quantity("white-point", rate=0.01),))  # doctest: +SKIP
    """
    return QUANTITIES.register(name)


@dataclass(frozen=True, kw_only=True)
class Learning:
    """How fast a quantity is learned: by Adam, when an image that it belongs to is trained on.

    Attributes
    ----------
    rate, rate_final, decay_steps : float, float, int
        The learning rate decays log-linearly from ``rate`` to ``rate_final`` over ``decay_steps`` iterations of the
        run, all stages counted.
    start : int
        Learned when iteration of the run > start: the first splats do not say yet what a camera does.
    beta1, beta2, eps : float
        Constants of Adam.
    """

    rate: float = 1e-3
    rate_final: float = 1e-5
    decay_steps: int = 30_000
    start: int = 500
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15

    def rate_at(self, iteration: int) -> float:
        """Return the rate at an iteration of the run (1-based): log-linear, then constant; 0 before the start."""
        if iteration <= self.start:
            return 0.0
        t = min(max(iteration / self.decay_steps, 0.0), 1.0)
        return math.exp((1.0 - t) * math.log(self.rate) + t * math.log(self.rate_final))

    def check(self, where: str, without: str = "") -> None:
        """Raise RecipeError for numbers that cannot be; ``without``: how to leave the quantity out."""
        for name in ("rate", "rate_final", "eps"):
            value = number(f"{where}.{name}", getattr(self, name), low=0.0)
            require(value > 0, f"{where}.{name} must be positive, got {value}{without and f' ({without})'}")
        for name in ("beta1", "beta2"):
            number(f"{where}.{name}", getattr(self, name), low=0.0)
        require(max(self.beta1, self.beta2) < 1, f"{where}.beta1 and {where}.beta2 must be below 1")
        integer(f"{where}.decay_steps", self.decay_steps, low=1)
        integer(f"{where}.start", self.start, low=0)
        if hasattr(self, "prior"):
            number(f"{where}.prior", self.prior, low=0.0)

    def _check_small(self, where: str, units: str) -> None:
        for name in ("rate", "rate_final"):
            value = getattr(self, name)
            require(value <= 1, f"{where}.{name} must be at most 1 ({units}), got {value}")

    def _check_flags(self, where: str, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            require(isinstance(value, bool), f"{where}.{name} must be true or false, got {value!r}")


@dataclass(frozen=True, kw_only=True)
class Exposure(Learning):
    """Exposure and white balance: an affine transform of colour for each training image.

    ``start`` gives colours time to leave the grey that random points begin with.

    Attributes
    ----------
    prior : float
        Weight of the summed squares of what a transform differs from the identity by.
    initial : "identity", "points" or "given"
        What transforms begin as: the identity, or the gains by which the colours of sparse points differ between images
        (``training/point_gains.py``), so that no splat ever explains an exposure. "given": the trainer gets transforms
        that another training found, and they stay.
    """

    rate: float = 0.05
    rate_final: float = 0.001
    prior: float = 0.001
    initial: str = "identity"

    def check(self, where: str, without: str = "exposure=null leaves exposures alone") -> None:
        """Raise RecipeError for numbers that make no exposures."""
        super().check(where, without)
        one_of(f"{where}.initial", self.initial, ("identity", "points", "given"))


@dataclass(frozen=True, kw_only=True)
class PoseRefinement(Learning):
    """Poses: a rigid motion for each training camera, in stages that train the means of all splats.

    Rates are in rad, and in shares of the scene's extent. A schedule of a tenth has a tenth of the updates, and 3.2
    times the rates (``schedule``). A camera is updated once an epoch, some hundred times in all: with a longer memory
    (``beta2``) Adam would remember the start.
    """

    rate: float = 5e-4
    rate_final: float = 5e-6
    beta2: float = 0.99

    def check(self, where: str, without: str = "poses=null leaves cameras alone") -> None:
        """Raise RecipeError for numbers that make no poses."""
        super().check(where, without)
        self._check_small(where, "rad, extents")


@dataclass(frozen=True, kw_only=True)
class IntrinsicsRefinement(Learning):
    """Focal length and lens of each camera, in the stages that learn poses.

    Images whose files have the same intrinsics share a camera. The rate is of the logarithm of the focal length; a
    camera that all images share is updated in every iteration. Rates grow in shorter schedules.

    Attributes
    ----------
    principal_point : bool
        Whether the principal point is learned, too. A turn of the camera looks nearly the same.
    distortion : bool
        Whether two radial coefficients of a residual lens are learned, too, at the same rate as a share of the distance
        from the image's centre to its corner. ``--refine-cameras`` learns them.
    """

    rate: float = 1e-4
    rate_final: float = 1e-6
    principal_point: bool = False
    distortion: bool = False

    def check(self, where: str, without: str = "intrinsics=null leaves focal lengths alone") -> None:
        """Raise RecipeError for numbers that make no focal lengths."""
        self._check_flags(where, "principal_point", "distortion")
        super().check(where, without)
        self._check_small(where, "shares of the focal length")


@dataclass(frozen=True, kw_only=True)
class Photometry(Learning):
    """Vignetting and response of each camera; beside ``exposure``, or without it.

    Images whose files have the same intrinsics share a camera. Rates grow in shorter schedules.

    Attributes
    ----------
    vignetting : bool
        Whether light may fall off towards the corners.
    response : bool
        Whether the curves are learned by which the light of several cameras becomes values: what they differ by.
    prior : float
        Weight of the summed squares of the numbers of a camera.
    """

    vignetting: bool = True
    response: bool = True
    prior: float = 0.001

    def check(self, where: str, without: str = "photometry=null leaves cameras alone") -> None:
        """Raise RecipeError for numbers that make no vignetting and no response."""
        self._check_flags(where, "vignetting", "response")
        either = self.vignetting or self.response
        neither = "must learn vignetting, response or both, got neither; photometry=null leaves both alone"
        require(either, f"{where} {neither}")
        super().check(where, without)
        self._check_small(where, "of the numbers of a camera")


@dataclass(frozen=True, kw_only=True)
class Quantity(Learning):
    """A registered quantity by its name (docs/extending.md).

    Attributes
    ----------
    name : str
    rate, rate_final, decay_steps : float, float, int
        The learning rate decays log-linearly from ``rate`` to ``rate_final`` over ``decay_steps`` iterations of the
        run.
    start : int
        Learned when iteration of the run > start.
    beta1, beta2, eps : float
        Constants of Adam.
    prior : float
        Weight of the summed squares of the numbers of an image.
    options : mapping of str to values of JSON
        Keyword arguments of its constructor.

    Raises
    ------
    RecipeError
        If no quantity has this name.
    """

    name: str = field(kw_only=False)
    prior: float = 0.0
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        QUANTITIES.check(self.name)
