"""Report failures of single results as events, so that they do not end the run."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from gs2d.config.registry import origin_of
from gs2d.core.atomic_files import is_full
from gs2d.errors import Gs2dError
from gs2d.io.run_dir import MESH, PAGE, REPORT, TEXTURED, VERDICT, RunFolder
from gs2d.training.events import NotMade, OnEvent

LONGEST = 500  # characters of a message that is not ours
REMADE_BY = {  # files of a finished run, and the command that makes them again
    MESH: ("mesh",),
    TEXTURED: ("mesh", "--texture"),
    REPORT: ("evaluate",),
    VERDICT: ("evaluate",),
    PAGE: ("export", "--format", "html"),
}


@contextmanager
def attempted(what: str, command: str | None, on_event: OnEvent) -> Iterator[None]:
    """Send a :class:`~gs2d.training.events.NotMade` event if the body fails to make a file or section, and continue.

    A full disk and a closed output pipe end the run all the same. ``command`` makes it later (:func:`again`); None: the
    same command with ``--resume``; "": nothing does.
    """
    try:
        yield
    except Exception as error:
        if is_full(error) or isinstance(error, BrokenPipeError):
            raise
        on_event(NotMade(what, reason_of(error), command, error))


def again(verb: str, path: Path, *more: object) -> str:
    """Return the command line of ``gs2d VERB`` for a run."""
    return shlex.join(["gs2d", verb, str(path), *map(str, more)])


def remade_by(run: RunFolder, name: str) -> str:
    """Return the command line that makes a file of a finished run again."""
    verb, *more = REMADE_BY[name]
    return again(verb, run.path, *more)


def attempted_file(run: RunFolder, name: str, on_event: OnEvent) -> AbstractContextManager[None]:
    """Attempt to make a file of a finished run."""
    return attempted(name, remade_by(run, name), on_event)


def reason_of(error: Exception) -> str:
    """Return an error in one line; an unexpected one is a fault of gs2d or of a plug-in."""
    text = " ".join(str(error).split())
    if isinstance(error, Gs2dError):
        return text
    if isinstance(error, MemoryError):
        return "out of memory"
    return f"fault in {origin_of(error)}: {type(error).__name__}: {text[:LONGEST] or 'no message'}"
