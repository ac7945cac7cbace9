"""Fewer faces by quadric edge collapse, of large meshes in a process of its own.

The library keeps what it took, 280 bytes a face, for as long as its process lives, and a run that is meshed has a page
and a report to write yet.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
from typing import Any

import numpy as np

from gs2d.core.memory import trim

# Of glibc. Its vectors double as they grow, beyond 2^18 faces to 46 MB; what they leave then goes back at once, which
# spares a mesh just above 20 MB.
_MAPPED_BYTES = "131072"
OWN_PROCESS_FACES = 100_000  # from which a process of its own (a fifth of a second) is worth what it gives back
_PROGRAM = """
import io, sys
import numpy as np
import fast_simplification
data = np.load(io.BytesIO(sys.stdin.buffer.read()))
points, faces = fast_simplification.simplify(data["points"], data["faces"], target_count=int(data["count"]))
np.savez(sys.stdout.buffer, points=points, faces=faces)
"""


def collapse(points: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points [P, 3] and faces [F, 3] of about ``count`` faces; the same bytes in whichever process.

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
    import fast_simplification  # here: it is slow to import

    points, faces = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(faces, np.int32)
    if len(faces) >= OWN_PROCESS_FACES and (found := _elsewhere(points, faces, count)) is not None:
        return found
    collapsed: Any = fast_simplification.simplify(points, faces, target_count=count)
    return collapsed[0], collapsed[1]


def _elsewhere(points: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Collapse in another process; None where none can be had, or it came to grief."""
    packed = io.BytesIO()
    np.savez(packed, points=points, faces=faces, count=count)
    trim()  # the other process comes beside this one, which looked views up until now
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
