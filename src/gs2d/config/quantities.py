"""Quantities of images and cameras that a recipe learns with the splats. Pure Python; never imports torch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from gs2d.config.registry import Register, Registry
from gs2d.config.validate import integer, number, require
from gs2d.errors import RecipeError

QUANTITIES: Registry[Any] = Registry(
    "quantity",
    "gs2d.quantities",
    builtin={
        "intrinsics": "gs2d.training.learned.camera_intrinsics",
        "poses": "gs2d.training.learned.camera_pose",
        "exposure": "gs2d.training.learned.image_exposure",
    },
    error=RecipeError,
)
"""Names of learned quantities -> subclasses of ``gs2d.training.learned.quantity.LearnedQuantity``."""
LEAST_START = 200  # iterations without learned quantities that a shorter schedule keeps, where it has them


def register_quantity(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers a learned quantity, so that ``Recipe.learned`` can name it.

    Parameters
    ----------
    name : str
        Must not be taken.

    Returns
    -------
    callable
        Decorates a subclass of ``gs2d.training.learned.quantity.LearnedQuantity``. Its constructor takes the
        :class:`Quantity`, the scene and the options of the quantity as keyword arguments.

    Examples
    --------
    The guide "Extending gs2d" has a whole quantity.

    >>> @gs2d.register_quantity("white-point")  # doctest: +SKIP
    ... class WhitePoint(LearnedQuantity): ...
    >>> recipe = recipe.with_learned(gs2d.Quantity("white-point", rate=0.01))  # doctest: +SKIP
    """
    return QUANTITIES.register(name)


@dataclass(frozen=True)
class Quantity:
    """A learned quantity and its learning rate. Adam updates it when one of its images is trained on.

    Attributes
    ----------
    name : str
        "exposure", "poses", "intrinsics" or a registered one (docs/extending.md).
    rate, rate_final, decay_steps : float, float, int
        The learning rate decays log-linearly from ``rate`` to ``rate_final`` over ``decay_steps`` iterations of the
        run, all stages counted.
    start : int
        Iterations of the run without updates, in which the first splats form.
    stretch : float
        A schedule ``f`` times as long has both rates times ``f ** -stretch``, because it has fewer updates.
    prior : float
        Weight of the squared numbers of an image in the loss.
    options : mapping of str to values of JSON
        Keyword arguments of the quantity's constructor.

    Raises
    ------
    RecipeError
        If no quantity has this name.
    """

    name: str
    rate: float = 1e-3
    rate_final: float = 1e-5
    decay_steps: int = 30_000
    start: int = 500
    stretch: float = 0.5
    prior: float = 0.0
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        QUANTITIES.check(self.name)

    def rate_at(self, iteration: int) -> float:
        """Return the rate at an iteration of the run (1-based): log-linear, then constant; 0 before the start."""
        if iteration <= self.start:
            return 0.0
        t = min(max(iteration / self.decay_steps, 0.0), 1.0)
        return math.exp((1.0 - t) * math.log(self.rate) + t * math.log(self.rate_final))

    def with_options(self, **options: Any) -> Quantity:
        """Return the quantity with further options, or other values of them."""
        return replace(self, options={**self.options, **options})

    def scaled(self, factor: float) -> Quantity:
        """Return the quantity for a schedule ``factor`` times as long.

        A splat needs a number of iterations to form, whatever the schedule, so the start shrinks less than the rest.
        """
        decay_steps, longer = max(1, round(self.decay_steps * factor)), 1 / factor**self.stretch
        least = min(self.start, LEAST_START, decay_steps // 6)
        return replace(
            self,
            rate=self.rate * longer,
            rate_final=self.rate_final * longer,
            decay_steps=decay_steps,
            start=max(least, round(self.start * factor)),
        )

    def check(self, where: str) -> None:
        """Raise RecipeError for values that cannot be trained with."""
        for name in ("rate", "rate_final"):
            value = number(f"{where}.{name}", getattr(self, name), low=0.0)
            require(0 < value <= 1, f"{where}.{name} must be in (0, 1], got {value}; to leave it out, remove the entry")
        integer(f"{where}.decay_steps", self.decay_steps, low=1)
        integer(f"{where}.start", self.start, low=0)
        for name in ("stretch", "prior"):
            number(f"{where}.{name}", getattr(self, name), low=0.0)


EXPOSURE = Quantity("exposure", 0.05, 0.001, stretch=0.0, prior=0.001)
"""Exposure and white balance: an affine colour transform of each training image.

Option ``initial``: "identity"; "points", the gains by which colours of sparse points differ between images; or
"given", fixed transforms of an earlier training.
"""
POSES = Quantity("poses", 5e-4, 5e-6)
"""A rigid motion of each training camera, in stages that train the means of all splats. Rates: rad, scene extents."""
INTRINSICS = Quantity("intrinsics", 1e-4, 1e-6)
"""Focal length of each camera, learned with the poses; the rate is of its logarithm.

Images whose files have the same intrinsics share a camera. Option: ``principal_point``, false by default.
"""
