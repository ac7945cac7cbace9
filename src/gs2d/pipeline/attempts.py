"""Finished splats are a result: a picture, a report or a page that cannot be made beside them does not end the run."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gs2d.core.atomic_files import is_full
from gs2d.errors import Gs2dError
from gs2d.training.events import NotMade, OnEvent

LONGEST = 500  # characters of a message that is not ours


@contextmanager
def attempted(what: str, command: str | None, on_event: OnEvent) -> Iterator[None]:
    """Try to make something; where it fails, say so in one line and go on.

    A full disk ends the run all the same (nothing else could be written either), and so does a reader of the output
    that went away.

    Parameters
    ----------
    what : str
        What is made: a file or a section.
    command : str or None
        What makes it again (:func:`again`); None: the same command with ``--resume``; "": nothing does.
    on_event : callable
        Is told :class:`~gs2d.training.events.NotMade`.
    """
    try:
        yield
    except Exception as error:
        if is_full(error) or isinstance(error, BrokenPipeError):
            raise
        on_event(NotMade(what, reason_of(error), command, error))


def again(verb: str, path: Path, *more: object) -> str:
    """Return the command that makes something of a run again."""
    return shlex.join(["gs2d", verb, str(path), *map(str, more)])


def reason_of(error: Exception) -> str:
    """Return what went wrong in one line; a fault of ours is called one."""
    text = " ".join(str(error).split())
    if isinstance(error, Gs2dError):
        return text
    if isinstance(error, MemoryError):
        return "out of memory"
    return f"fault in gs2d: {type(error).__name__}: {text[:LONGEST] or 'no message'}"
