"""The readers of captures, by the name of their format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from gs2d.config.registry import Register, Registry
from gs2d.data.build import Capture
from gs2d.data.scene import Scene
from gs2d.errors import DataError

__all__ = ["READERS", "Reader", "register_reader"]

_CORE = ("blender", "nerfstudio", "colmap")


class Reader(Protocol):
    """How a capture format is detected and read. Register a class whose constructor needs no arguments.

    Optional attributes: ``looks_for`` names the expected files in messages, such as "cameras.xml (Metashape)";
    ``before_colmap = True`` tests a format first whose captures also contain a COLMAP model.
    """

    def detect(self, path: Path) -> bool:
        """Whether a folder holds a capture of this format; looks at names, and opens little."""

    def read(self, path: Path, *, downscale: int) -> Capture | Scene:
        """Read a capture, or raise DataError.

        Of a :class:`Capture` (photographs by their files, with cameras) gs2d makes the scene: it shrinks photographs,
        splits off test views, undistorts, checks. ``downscale`` is for readers that have smaller files
        (``Capture.downscaled_by``). A :class:`Scene` is taken as it is.
        """


READERS: Registry[Callable[[], Reader]] = Registry(
    "format", "gs2d.readers", builtin=dict.fromkeys(_CORE, "gs2d.data.load"), error=DataError
)
"""Names of formats -> classes of readers; in the order in which a folder is looked at."""


def register_reader(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers a reader of captures, so that ``load_scene`` recognises its format.

    Parameters
    ----------
    name : str
        Format of the captures, also for ``--format``; must not be taken.

    Returns
    -------
    callable
        Decorates a class without constructor arguments. Its method ``detect(path)`` returns whether a folder is of
        this format; ``read(path, *, downscale)`` returns a Scene or a ``gs2d.data.build.Capture``.

    Raises
    ------
    DataError
        From the decorator: the name is taken.

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
