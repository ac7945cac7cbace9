"""Compile the CUDA kernels for every architecture into the package, for a wheel that needs no compiler where it runs.

::

    PYTHONPATH=src python scripts/build_cubins.py [FOLDER]
    python -m pip wheel . --no-deps

FOLDER is ``src/gs2d/kernels/cuda/cubins`` by default, which git ignores and a wheel takes in. Build with the oldest
CUDA that knows all architectures, 12.8 (``pip install cuda-bindings==12.8.* nvidia-cuda-nvrtc-cu12==12.8.*``): a driver
takes code of its own major version of CUDA and of older ones. Kernels that spill are refused. No GPU is needed.
"""

from __future__ import annotations

import json
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path

import gs2d
from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda.shipped import FOLDER, MANIFEST, PTX, SHIPPED, digest_of, entry_of


def build(folder: Path, architectures: Sequence[str] = (*SHIPPED, PTX), names: Sequence[str] | None = None) -> int:
    """Write an archive for each architecture and the manifest, which comes last; bytes of all."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MANIFEST).unlink(missing_ok=True)
    for arch in architectures:
        with zipfile.ZipFile(folder / f"{arch}.zip", "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            for name in nvrtc.source_names() if names is None else names:
                made = nvrtc.compile_source(name, arch)
                spilled = [kernel for kernel, usage in made.usage().items() if usage.spilled_bytes]
                if spilled and arch.startswith("sm_"):
                    raise BackendError(f"{', '.join(spilled)} of {name} spill on {arch}; build with another CUDA")
                archive.writestr(zipfile.ZipInfo(entry_of(name)), made.code, zipfile.ZIP_DEFLATED, 9)
        print(f"{arch}: {(folder / f'{arch}.zip').stat().st_size} bytes")
    manifest = {
        "version": gs2d.__version__,
        "sources": digest_of(nvrtc.sources(), nvrtc.OPTIONS),
        "cuda": list(nvrtc.nvrtc_version()),
        "architectures": list(architectures),
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return sum(path.stat().st_size for path in folder.iterdir())


def main(arguments: Sequence[str] | None = None) -> int:
    """Build into the folder that is named, or into the package."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    folder = Path(given[0]) if given else Path(nvrtc.__file__).parent / FOLDER
    try:
        size = build(folder)
    except BackendError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{folder}: {size} bytes, CUDA {'.'.join(map(str, nvrtc.nvrtc_version()))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
