"""Runs the parts of the report one by one, so that a part that fails does not lose the others."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from gs2d.core.atomic_files import is_full
from gs2d.core.memory import trim

T = TypeVar("T")
OnFailure = Callable[[str, Exception], None]
"""Receives the name of a part that failed, and its error."""


class Guard:
    """Make the parts of a page.

    Parameters
    ----------
    on_failure : callable or None
        Receives the name and the error of each part that fails.
    """

    def __init__(self, on_failure: OnFailure | None) -> None:
        self._on_failure = on_failure

    def __call__(self, name: str, build: Callable[[], T]) -> T | str:
        """Return the result of ``build``, or a sentence if it raises; a full disk is raised."""
        try:
            return build()
        except Exception as error:
            if is_full(error):
                raise
            if self._on_failure is not None:
                self._on_failure(name, error)
            why = " ".join(str(error).split()) or type(error).__name__
            return f"The {name} could not be made: {why}"
        finally:
            trim()  # images and meshes were in memory
