"""Densifiers by name. Pure Python: a name is checked without torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from gs2d.config.registry import Register, Registry
from gs2d.errors import RecipeError

DENSIFIERS: Registry[Any] = Registry(
    "densifier",
    "gs2d.densifiers",
    builtin={
        "gradient": "gs2d.training.densify.gradient",
    },
    error=RecipeError,
)
"""Names of densifiers -> classes of ``gs2d.training.densify.densifier.Densifier``."""


def register_densifier(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers a densifier, so that a stage can use ``Densify(name, options)``.

    Parameters
    ----------
    name : str
        Must not be taken.

    Returns
    -------
    callable
        Decorates a subclass of ``gs2d.training.densify.densifier.Densifier``. Its constructor takes the surroundings
        and the options as keyword arguments; ``before_backward`` and ``after_backward`` are called in every iteration.

    Examples
    --------
    The guide "Extending gs2d" has a whole densifier.

    >>> @gs2d.register_densifier("prune-faint")  # doctest: +SKIP
    ... class PruneFaint(Densifier): ...
    >>> stage = replace(recipe.stages[0], densify=Densify("prune-faint", {"at": 500}))  # doctest: +SKIP
    """
    return DENSIFIERS.register(name)


@dataclass(frozen=True)
class Densify:
    """A registered densifier; ``GradDensify`` is that of 2DGS and AbsGS, with its options as fields.

    The options, values of JSON, are keyword arguments of its constructor. Options called ``start`` and ``stop`` are
    iterations of the stage, and scale with the schedule. Raises RecipeError if no densifier has this name.
    """

    name: str
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        DENSIFIERS.check(self.name)

    @property
    def stop(self) -> int:
        """The option ``stop``, or 0."""
        return int(self.options.get("stop", 0))

    def scaled(self, factor: float) -> Densify:
        """Return the densifier for a schedule ``factor`` times as long."""
        scaled = {name: round(self.options[name] * factor) for name in ("start", "stop") if name in self.options}
        return Densify(self.name, {**self.options, **scaled})
