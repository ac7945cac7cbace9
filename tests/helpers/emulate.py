"""Compile CUDA sources for the CPU (emulator.h) and call their kernels on tensors in host memory.

Compiled libraries are cached in build/emulated under a digest of their inputs.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import re
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import gs2d.kernels
from gs2d.core.locks import try_lock
from gs2d.kernels.cuda.launch import Launcher

HERE = Path(__file__).parent
KERNELS = Path(gs2d.kernels.__file__).parent
KEPT = HERE.parents[1] / "build" / "emulated"
# As in the GPU build: no contraction; every fused multiply-add is explicit. -march only makes fmaf fast.
FLAGS = (
    "-std=c++17",
    "-O1",
    "-fPIC",
    "-shared",
    "-fno-gnu-unique",  # do not share static variables with other libraries
    "-ffp-contract=off",
    "-fno-math-errno",
    "-Wall",
    "-Wno-unknown-pragmas",
)
ADDRESSES = ("-fsanitize=address", "-fno-omit-frame-pointer", "-g")  # needs the run-time library in the process
# Includes -fsanitize=alignment for float4: misaligned access is an error on a GPU.
UNDEFINED = ("-fsanitize=undefined", "-fno-sanitize-recover=all", "-g")
KERNEL = re.compile(r'extern "C" __global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\(')


class EmulatedKernels:
    """Kernels of some CUDA sources as functions that run on the CPU."""

    def __init__(self, library: Path) -> None:
        self._dll = ctypes.CDLL(str(library))

    def launch(
        self,
        name: str,
        grid: tuple[int, int],
        block: int,
        arguments: ctypes.Structure,
        *,
        descending: bool = False,
        seed: int = 0,
    ) -> None:
        """Run a whole grid; raise RuntimeError with the emulator's message if threads diverge at a collective.

        With ``seed`` > 0, threads, warps and blocks run in a random order.
        """
        function = self._dll[f"launch_{name}"]
        function.restype = ctypes.c_char_p
        function.argtypes = [ctypes.c_uint] * 3 + [ctypes.c_int, ctypes.c_void_p]
        error = function(grid[0], grid[1], block, seed + 1 if seed else int(descending), ctypes.byref(arguments))
        if error is not None:
            raise RuntimeError(f"{name}: {error.decode()}")


def build(
    sources: Sequence[Path],
    include: Path,
    *,
    approximate: bool = False,
    addresses: bool = False,
    undefined: bool = False,
) -> EmulatedKernels:
    """Compile the sources unless a cached library exists. Skip without g++.

    ``approximate``: apply the largest errors of the approximate instructions. ``addresses``: use AddressSanitizer;
    ``undefined``: undefined behaviour aborts the process.
    """
    if shutil.which("g++") is None:
        pytest.skip("no g++ here, which runs the CUDA kernels on the CPU; install one")
    chosen = ["-DEMULATE_APPROXIMATIONS"] if approximate else []
    chosen += ADDRESSES if addresses else []
    chosen += UNDEFINED if undefined else []
    command = ["g++", *FLAGS, *chosen, f"-I{include}"]
    wrapper = wrapper_of(sources)
    digest = hashlib.sha256("\0".join([compiler(), *command, wrapper]).encode())
    for path in (*sources, *sorted(HERE.glob("*.h")), *sorted(include.rglob("*.h"))):
        digest.update(path.read_bytes() + b"\0")
    library = KEPT / f"{sources[0].stem}-{digest.hexdigest()[:24]}.so"
    KEPT.mkdir(parents=True, exist_ok=True)
    with library.with_suffix(".lock").open("w") as lock:
        while not try_lock(lock.fileno()):  # another worker is compiling
            time.sleep(0.2)
        if not library.exists():
            compile_into(library, command, wrapper)
            forget_old()
    os.utime(library)
    return EmulatedKernels(library)


def wrapper_of(sources: Sequence[Path]) -> str:
    """Return the source of a library: the CUDA sources plus one function per kernel."""
    lines = [f'#include "{HERE / "emulator.h"}"']
    lines.append("namespace gs2d {}\nusing namespace gs2d;")  # the namespace of our kernels
    lines += [f'#include "{path}"' for path in sources]
    signature = "(unsigned x, unsigned y, unsigned block, int order, const void* a)"
    for kernel in [kernel for source in sources for kernel in KERNEL.findall(source.read_text())]:
        body = f"return emulator::launch({kernel}, x, y, block, order, a);"
        lines.append(f'extern "C" const char* launch_{kernel}{signature} {{ {body} }}')
    return "\n".join(lines) + "\n"


@functools.cache
def compiler() -> str:
    """Return the version of g++."""
    return subprocess.run(["g++", "--version"], capture_output=True, text=True, check=True).stdout


def compile_into(library: Path, command: Sequence[str], wrapper: str) -> None:
    """Compile to a temporary file, then rename it, so that the library is always complete."""
    source, made = library.with_suffix(".cpp"), library.with_suffix(".tmp")
    source.write_text(wrapper)
    words = [*command, str(source), "-o", str(made)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"g++ failed on {library.stem.partition('-')[0]}:\n{done.stderr[-4000:]}")
    made.rename(library)


def forget_old() -> None:
    """Remove libraries unused for a week: every header change creates new ones."""
    for path in KEPT.iterdir():
        if time.time() - path.stat().st_mtime > 7 * 24 * 3600 and path.suffix == ".so":
            for suffix in (".so", ".cpp", ".lock"):
                path.with_suffix(suffix).unlink(missing_ok=True)


@dataclass(frozen=True)
class Emulator(Launcher):
    """A launcher (``gs2d.kernels.cuda.launch``) that runs the package's kernels on tensors in host memory.

    Each source file is compiled when one of its kernels is first launched.
    """

    descending: bool = False
    seed: int = 0
    approximate: bool = False
    addresses: bool = False
    undefined: bool = False
    _built: dict[str, EmulatedKernels] = field(default_factory=dict)

    def launch(self, name: str, blocks: int, threads: int, arguments: ctypes.Structure) -> None:
        if blocks == 0:
            return
        if name not in self._built:
            source = next(s for s in sorted((KERNELS / "cuda").glob("*.cu")) if name in KERNEL.findall(s.read_text()))
            sanitizers = {"addresses": self.addresses, "undefined": self.undefined}
            built = build([source], KERNELS, approximate=self.approximate, **sanitizers)
            self._built.update(dict.fromkeys(KERNEL.findall(source.read_text()), built))
        self._built[name].launch(name, (blocks, 1), threads, arguments, descending=self.descending, seed=self.seed)
