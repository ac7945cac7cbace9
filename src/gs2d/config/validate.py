"""Checks of recipe values, which raise a RecipeError with their position. Pure Python; never imports torch."""

from __future__ import annotations

import math

from gs2d.errors import RecipeError


def require(condition: bool, message: str) -> None:
    """Raise RecipeError with the message unless the condition holds."""
    if not condition:
        raise RecipeError(message)


def integer(where: str, value: object, *, low: int) -> None:
    """Require an integer of at least ``low``."""
    ok = isinstance(value, int) and not isinstance(value, bool) and value >= low
    require(ok, f"{where} must be an integer >= {low}, got {value!r}")


def number(where: str, value: object, *, low: float) -> float:
    """Require a finite number of at least ``low``, and return it as a float."""
    ok = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= low
    require(ok, f"{where} must be a finite number >= {low:g}, got {value!r}")
    assert isinstance(value, int | float)
    return float(value)


def one_of(where: str, value: str, choices: tuple[str, ...]) -> None:
    """Require one of the choices."""
    require(value in choices, f"{where} must be one of {', '.join(choices)}; got {value!r}")


def group(where: str, name: str, groups: list[str]) -> None:
    """Require a row group that an earlier action writes."""
    written = f"the groups written so far are {', '.join(groups)}" if groups else "no action has written a group yet"
    require(name in groups, f"{where}: no earlier action writes the row group {name!r}; {written}")
