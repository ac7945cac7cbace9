"""Entry actions of a stage, by name. Pure Python: a name is checked without torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from gs2d.config.registry import Register, Registry
from gs2d.errors import RecipeError

ACTIONS: Registry[Any] = Registry(
    "action",
    "gs2d.actions",
    builtin={
        "rank_by_error": "gs2d.training.actions.rank_by_error",
        "clone_in_place": "gs2d.training.actions.clone_in_place",
    },
    error=RecipeError,
)
"""Names of entry actions -> subclasses of ``gs2d.training.actions.entry_action.EntryAction``."""


def register_action(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers an entry action, so that a stage can use ``Action(name, options)``.

    Parameters
    ----------
    name : str
        Must not be taken.

    Returns
    -------
    callable
        Decorates a subclass of ``gs2d.training.actions.entry_action.EntryAction``. Its constructor takes the options as
        keyword arguments; ``run`` is called once, before the first iteration of the stage.

    Examples
    --------
    The guide "Extending gs2d" has a whole action.

    >>> @gs2d.register_action("select-near")  # doctest: +SKIP
    ... class SelectNear(EntryAction): ...
    >>> stage = replace(stage, on_enter=(Action("select-near", {"writes": "near"}),))  # doctest: +SKIP
    """
    return ACTIONS.register(name)


@dataclass(frozen=True)
class Action:
    """A registered entry action; RecipeError if no action has this name.

    The options, values of JSON, are keyword arguments of its constructor. An option called ``writes`` is the row group
    that the action writes, one called ``rows`` the row group that it reads: an earlier action must write that.
    """

    name: str
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        ACTIONS.check(self.name)

    @property
    def writes(self) -> str | None:
        """The row group that the action writes."""
        return self.options.get("writes")

    def with_options(self, **options: Any) -> Action:
        """Return the action with further options, or other values of them."""
        return replace(self, options={**self.options, **options})


RANK_BY_ERROR = Action("rank_by_error", {"top_percent": 1.0, "writes": "high_error"})
"""The worst ``top_percent`` of the splats by E_i over all training views (paper Eq. 8) become a row group.

With the option ``occlusion`` a pixel counts only for the splats that are blended there.
"""
CLONE_IN_PLACE = Action("clone_in_place", {"rows": "high_error", "writes": "clones", "opacity": "copy"})
"""Append an exact copy of the rows of a group.

``opacity`` "copy" keeps the opacity of both (the paper). "preserve" gives both 1 - sqrt(1 - o). The transmittance at
the centre of the pair then equals that of the single splat; away from the centre it is slightly lower.
"""
