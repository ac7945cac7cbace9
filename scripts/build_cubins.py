"""Compile the CUDA kernels for every architecture into the package, for a wheel that needs no compiler at run time.

::

    PYTHONPATH=src python scripts/build_cubins.py [FOLDER]
    python -m pip wheel . --no-deps

FOLDER is ``src/gs2d/kernels/cuda/cubins`` by default, which git ignores and wheels include. Build with the oldest CUDA
version that supports all architectures, 12.8 (``pip install cuda-bindings==12.8.* nvidia-cuda-nvrtc-cu12==12.8.*``): a
driver accepts code of its own and of older major CUDA versions. Kernels that spill are rejected. No GPU is needed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import gs2d
from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda.shipped import FOLDER, PTX, SHIPPED, digest_of, write_archives


def build(folder: Path, architectures: Sequence[str] = (*SHIPPED, PTX), names: Sequence[str] | None = None) -> int:
    """Write archives and their manifest; return their total bytes."""

    def code_of(name: str, arch: str) -> bytes:
        made = nvrtc.compile_source(name, arch)
        spilled = [kernel for kernel, usage in made.usage().items() if usage.spilled_bytes]
        if spilled and arch.startswith("sm_"):
            raise BackendError(f"{', '.join(spilled)} of {name} spill on {arch}; build with another CUDA")
        return made.code

    facts = {
        "version": gs2d.__version__,
        "sources": digest_of(nvrtc.sources(), nvrtc.OPTIONS),
        "cuda": list(nvrtc.nvrtc_version()),
    }
    return write_archives(folder, architectures, names or nvrtc.source_names(), code_of, facts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Build into the requested folder, or into the package."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    folder = Path(given[0]) if given else Path(nvrtc.__file__).parent / FOLDER
    try:
        size = build(folder)
    except BackendError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for path in sorted(folder.glob("*.zip")):
        print(f"{path.stem}: {path.stat().st_size} bytes")
    print(f"{folder}: {size} bytes, CUDA {'.'.join(map(str, nvrtc.nvrtc_version()))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
