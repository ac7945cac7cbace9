"""The parts of the report, each tried by itself: one that fails is said in its place."""

from __future__ import annotations

from collections.abc import Callable

from gs2d.core.files import is_full
from gs2d.core.memory import trim
from gs2d.report.html import missing

OnFailure = Callable[[str, Exception], None]
"""Is told the name of a part and why it is not there."""


class Guard:
    """Make the parts of a page.

    Parameters
    ----------
    on_failure : callable or None
        Is told what failed; None: only the page says so.
    """

    def __init__(self, on_failure: OnFailure | None) -> None:
        self._on_failure = on_failure

    def __call__(self, name: str, build: Callable[[], str]) -> str:
        """Return what ``build`` returns, or one sentence where it raises; a full disk is no matter of one part."""
        try:
            return build()
        except Exception as error:
            if is_full(error):
                raise
            if self._on_failure is not None:
                self._on_failure(name, error)
            why = " ".join(str(error).split()) or type(error).__name__
            return missing(f"The {name} could not be made: {why}")
        finally:
            trim()  # pictures were decoded and meshes drawn
