"""The readers of captures, by name of the format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from gs2d.config.registry import Register, Registry
from gs2d.data.build import Capture
from gs2d.data.scene import Scene
from gs2d.errors import DataError

_CORE = {"colmap": "gs2d.data.readers.colmap"}


class Reader(Protocol):
    """How a capture format is detected and read. Register a class whose constructor needs no arguments.

    Optional attributes: ``looks_for`` names the expected files in messages, such as "cameras.xml (Metashape)";
    ``before_colmap = True`` tests a format first whose captures also contain a COLMAP model; ``protocol`` names the
    protocol of its captures (default: "generic").
    """

    def detect(self, path: Path) -> bool:
        """Whether a folder holds a capture of this format; must be fast."""

    def read(self, path: Path, *, downscale: int) -> Capture | Scene:
        """Read a capture, or raise DataError.

        gs2d converts a :class:`Capture` (image files with cameras) to a scene: it checks, undistorts, downscales and
        splits off test views. ``downscale`` is for readers with downscaled files (``Capture.downscaled_by``). A
        :class:`Scene` is used unchanged.
        """


READERS: Registry[Callable[[], Reader]] = Registry("format", "gs2d.readers", builtin=_CORE, error=DataError)
"""Readers by name of the format, in the order of detection."""


def register_reader(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers a reader of captures, so that ``load_scene`` recognises its format.

    Parameters
    ----------
    name : str
        Name of the format, also for ``--format``; must not be taken.

    Returns
    -------
    callable
        Decorates a class without constructor arguments. Its method ``detect(path)`` returns whether a folder has this
        format; ``read(path, *, downscale)`` returns a Scene or a ``gs2d.data.build.Capture``.

    Examples
    --------
    >>> import gs2d
    >>> @gs2d.register_reader("link")
    ... class LinkReader:
    ...     def detect(self, path):
    ...         return (path / "capture.txt").is_file()
    ...     def read(self, path, *, downscale):
    ...         return gs2d.load_scene((path / "capture.txt").read_text().strip(), downscale=downscale)
    """
    return READERS.register(name)
