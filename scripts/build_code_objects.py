"""Compile the kernels for AMD's GPUs with clang into the package, for a wheel that needs no compiler where it runs.

::

    PYTHONPATH=src python scripts/build_code_objects.py [FOLDER]
    python -m pip wheel . --no-deps

FOLDER is ``src/gs2d/kernels/cuda/cubins`` by default, where ``build_cubins.py`` puts NVIDIA's. Wanted: clang 17 or
newer with the AMDGPU target, and lld of the same version (Debian: ``apt install clang-19 lld-19``); ``$CLANG`` names
another one. Neither ROCm nor a GPU is needed. Kernels that spill are refused.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import gs2d
from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda import hiprtc
from gs2d.kernels.cuda.shipped import AMD_MANIFEST, FOLDER, digest_of, write_archives

NAMES = ("clang++-21", "clang++-20", "clang++-19", "clang++-18", "clang++-17", "clang++")
OLDEST = 17
# hiprtc's options besides: nothing of ROCm is included or linked, and the file is the code object itself.
ALONE = ("-x", "hip", "--cuda-device-only", "--no-gpu-bundle-output", "-nogpuinc", "-nogpulib")


@dataclass(frozen=True)
class Usage:
    """What the compiler says about one kernel.

    Attributes
    ----------
    registers : int
        Vector registers of a lane.
    scratch_bytes : int
        Of a lane, for what is spilled; 0 in a healthy kernel.
    shared_bytes : int
        Of a block.
    waves : int
        That a SIMD holds.
    """

    registers: int
    scratch_bytes: int
    shared_bytes: int
    waves: int


def find_clang() -> str:
    """Return a clang that compiles for AMD's GPUs.

    Raises
    ------
    BackendError
        There is none.
    """
    for name in [os.environ["CLANG"]] if os.environ.get("CLANG") else NAMES:
        path = shutil.which(name)
        if path is None:
            continue
        targets = subprocess.run([path, "--print-targets"], capture_output=True, text=True, check=False).stdout
        version = subprocess.run([path, "-dumpversion"], capture_output=True, text=True, check=False).stdout
        if "amdgcn" in targets and int(version.partition(".")[0] or 0) >= OLDEST:
            return path
    raise BackendError(
        f"no clang {OLDEST} or newer with the AMDGPU target is here; install one with its lld "
        "(Debian: apt install clang-19 lld-19), or name it in CLANG"
    )


def version_of(clang: str) -> tuple[int, int]:
    """Of the compiler, (major, minor)."""
    said = subprocess.run([clang, "-dumpversion"], capture_output=True, text=True, check=True).stdout
    major, minor = said.split(".")[:2]
    return int(major), int(minor)


def compile_source(clang: str, name: str, arch: str) -> tuple[bytes, dict[str, Usage]]:
    """Compile one file: the code object, and what each of its kernels takes.

    Raises
    ------
    BackendError
        The compiler refuses it, or warns.
    """
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for key, text in nvrtc.sources().items():
            path = folder / key
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
        (folder / "source.cu").write_text(hiprtc.prepared(name), encoding="utf-8")
        report = "-Rpass-analysis=kernel-resource-usage"
        command = [clang, *ALONE, *hiprtc.options_for(arch), report, f"-I{folder}", "source.cu", "-o", "code"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
        trouble = next((line for line in done.stderr.splitlines() if "error:" in line or "warning:" in line), "")
        if done.returncode != 0 or trouble:
            raise BackendError(f"{clang} refused {name} for {arch}: {trouble or done.stderr[-300:].strip()}")
        return (folder / "code").read_bytes(), _usage(done.stderr)


def _usage(log: str) -> dict[str, Usage]:
    found = {}
    for part in log.split("Function Name: ")[1:]:
        figures = {key: int(value) for key, value in re.findall(r"remark: +([A-Za-z]+)[^:\n]*: (\d+)", part)}
        found[part.split()[0]] = Usage(
            figures["VGPRs"], figures["ScratchSize"], figures.get("LDS", 0), figures["Occupancy"]
        )
    return found


def build(
    folder: Path,
    clang: str,
    architectures: Sequence[str] = hiprtc.AMD_SHIPPED,
    names: Sequence[str] | None = None,
) -> int:
    """Write archives and their manifest; bytes of all."""

    def code_of(name: str, arch: str) -> bytes:
        code, usage = compile_source(clang, name, arch)
        spilled = [kernel for kernel, one in usage.items() if one.scratch_bytes]
        if spilled:
            raise BackendError(f"{', '.join(spilled)} of {name} spill on {arch}; build with another clang")
        return code

    facts = {
        "version": gs2d.__version__,
        "sources": digest_of(nvrtc.sources(), hiprtc.OPTIONS),
        "clang": list(version_of(clang)),
    }
    return write_archives(folder, architectures, names or nvrtc.source_names(), code_of, AMD_MANIFEST, facts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Build into the folder that is named, or into the package."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    folder = Path(given[0]) if given else Path(nvrtc.__file__).parent / FOLDER
    try:
        clang = find_clang()
        size = build(folder, clang)
    except BackendError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for path in sorted(folder.glob("*.zip")):
        print(f"{path.stem}: {path.stat().st_size} bytes")
    print(f"{folder}: {size} bytes, {clang}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
