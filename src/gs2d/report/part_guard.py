"""Build the parts of the report separately, so that the failure of one does not affect the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from gs2d.core.atomic_files import is_full
from gs2d.core.memory import trim

T = TypeVar("T")
OnFailure = Callable[[str, Exception], None]
"""Receives the name of a part that failed, and its error."""


@dataclass(frozen=True)
class Guard:
    """Builds parts of a page; ``on_failure`` receives those that fail."""

    on_failure: OnFailure | None

    def __call__(self, name: str, build: Callable[[], T]) -> T | str:
        """Return the result of ``build``, or a sentence if it raises; a full disk is raised."""
        try:
            return build()
        except Exception as error:
            if is_full(error):
                raise
            if self.on_failure is not None:
                self.on_failure(name, error)
            return f"The {name} could not be made: {' '.join(str(error).split()) or type(error).__name__}"
        finally:
            trim()  # images and meshes were in memory
