"""The readers of captures, by the name of their format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from gs2d.config.registry import Registry
from gs2d.data.build import Capture
from gs2d.data.scene import Scene
from gs2d.errors import DataError

__all__ = ["READERS", "Reader", "register_reader"]

FORMATS = ("blender", "nerfstudio", "dtu", "colmap", "opensfm", "metashape", "alicevision")


class Reader(Protocol):
    """How a format of captures is recognised and read. A class is registered; it is made without arguments."""

    def detect(self, path: Path) -> bool:
        """Whether a folder holds a capture of this format; looks at names, and opens little."""

    def read(self, path: Path, *, downscale: int) -> Capture | Scene:
        """Read a capture, or raise DataError.

        Of a :class:`Capture` (photographs by their files, with cameras) gs2d makes the scene: it shrinks photographs,
        splits off test views, undistorts, checks. ``downscale`` is for readers that have smaller files
        (``Capture.downscaled_by``). A :class:`Scene` is taken as it is.
        """


READERS: Registry[Callable[[], Reader]] = Registry(
    "format", "gs2d.readers", builtin=dict.fromkeys(FORMATS, "gs2d.data.load"), error=DataError
)
"""Names of formats -> classes of readers; in the order in which a folder is looked at."""
register_reader = READERS.register
