"""`load_scene`: find out what a folder holds and read it."""

from __future__ import annotations

import os
from pathlib import Path

from gs2d.data.scene import Scene
from gs2d.errors import DataError

FORMATS = ("blender", "nerfstudio", "dtu", "colmap")
DEFAULT_CACHE_BYTES = 4 << 30  # 4 GiB of decoded pictures


def detect_format(path: str | os.PathLike[str]) -> str:
    """Which of FORMATS a folder holds.

    Raises
    ------
    DataError
        Missing or empty folder, or no known layout; lists what was looked for.
    """
    raise NotImplementedError


def load_scene(
    path: str | os.PathLike[str],
    *,
    format: str = "auto",
    downscale: int = 1,
    test_every: int | None = None,
    cache_bytes: int = DEFAULT_CACHE_BYTES,
) -> Scene:
    """Read a capture; nothing is decoded but image headers, and nothing is ever written.

    Parameters
    ----------
    path : path
        The capture's folder.
    format : str
        One of FORMATS, or "auto": by the files that are there.
    downscale : int
        Area-filter the photographs by this whole factor (COLMAP: ``images_N`` is used where it exists).
    test_every : int or None
        Every n-th view (sorted by name, from the first) is a test view where the data set has no split of its own;
        0 = all views train. None: 8, and 0 for DTU (whose protocol trains on all views).
    cache_bytes : int
        Bound on decoded pictures held in memory.

    Raises
    ------
    DataError
        Anything missing or wrong with the files; one line with expected, got and remedy.
    """
    raise NotImplementedError
