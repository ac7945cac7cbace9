"""Simplify meshes by quadric edge collapse; large meshes in a separate process.

The library does not release its memory, 280 bytes per face, before its process ends, and a run needs that memory later
for its page and report.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
from typing import Any

import numpy as np

from gs2d.core.memory import trim

# Setting of glibc: memory of large vectors, which double as they grow, is returned at once (up to 46 MB).
_MAPPED_BYTES = "131072"
OWN_PROCESS_FACES = 100_000  # from this number on, a separate process (0.2 s) saves enough memory
_PROGRAM = """
import io, sys
import numpy as np
import fast_simplification
data = np.load(io.BytesIO(sys.stdin.buffer.read()))
points, faces = fast_simplification.simplify(data["points"], data["faces"], target_count=int(data["count"]))
np.savez(sys.stdout.buffer, points=points, faces=faces)
"""


def collapse(points: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplify to about ``count`` faces; returns points [P, 3] and faces [F, 3], the same bytes in either process.

    Parameters
    ----------
    points : ndarray [P, 3] float32
    faces : ndarray [F, 3] int32
    count : int

    Raises
    ------
    ModuleNotFoundError
        The package fast_simplification is missing.
    """
    import fast_simplification  # slow to import

    points, faces = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(faces, np.int32)
    if len(faces) >= OWN_PROCESS_FACES and (found := _elsewhere(points, faces, count)) is not None:
        return found
    collapsed: Any = fast_simplification.simplify(points, faces, target_count=count)
    return collapsed[0], collapsed[1]


def _elsewhere(points: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Simplify in another process; None if it cannot be started or fails."""
    packed = io.BytesIO()
    np.savez(packed, points=points, faces=faces, count=count)
    trim()  # returns memory before the other process needs it
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _PROGRAM],
            input=packed.getbuffer(),
            capture_output=True,
            check=True,
            env={**os.environ, "MALLOC_MMAP_THRESHOLD_": _MAPPED_BYTES},
        )
        with np.load(io.BytesIO(done.stdout)) as data:
            return data["points"], data["faces"]
    except (OSError, subprocess.SubprocessError, ValueError, KeyError):
        return None
