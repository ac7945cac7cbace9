"""Compile the kernels for AMD's GPUs with hiprtc, which torch built for ROCm brings, and keep the code objects.

The sources are those for NVIDIA's, behind ``cuda/amd.h``. As there, what the package brings comes first, then the cache
(:mod:`gs2d.kernels.cuda.compile`). ``scripts/build_code_objects.py`` makes the same with clang alone.
"""

from __future__ import annotations

import ctypes
import re
from functools import cache
from pathlib import Path
from typing import Any

import torch

import gs2d
from gs2d.errors import BackendError
from gs2d.kernels.cuda.compile import cache_folder, kept_code, sources
from gs2d.kernels.cuda.hip import REMEDY, RUNTIME, find_library
from gs2d.kernels.cuda.shipped import AMD_MANIFEST, Shipped, digest_of, shipped

__all__ = ["AMD_SHIPPED", "OPTIONS", "architecture_of", "code_object", "compile_source", "options_for", "prepared",
           "ready_compiler", "shipped_objects", "wave_of"]  # fmt: skip

COMPILER = "libhiprtc"
# As for CUDA: no contraction but where a fused multiply-add is written. Adding floats in memory is an instruction.
OPTIONS = ("-std=c++17", "-O3", "-ffp-contract=off", "-munsafe-fp-atomics")
AMD_SHIPPED = ("gfx90a", "gfx942", "gfx1030", "gfx1100")
_KNOWN = re.compile(r"gfx(9[0-9a-f]{2}|1[0-9a-f]{3})")
_FIRST = '#include "cuda/amd.h"\n'


def architecture_of(device: torch.device) -> str:
    """Return what to compile for on a device: "gfx942".

    Raises
    ------
    BackendError
        No kernels can be made for it.
    """
    given = str(getattr(torch.cuda.get_device_properties(device), "gcnArchName", ""))
    name = given.partition(":")[0]  # gfx942:sramecc+:xnack-
    if not _KNOWN.fullmatch(name):
        raise BackendError(f"the GPU must be a gfx9 or newer of AMD's, got {given or 'none'}; use --backend cpu")
    return name


def wave_of(arch: str) -> int:
    """Return how many lanes the hardware runs together: 64 up to gfx9 (CDNA among them), 32 from gfx10 (RDNA)."""
    return 64 if arch.startswith("gfx9") else 32


def options_for(arch: str) -> tuple[str, ...]:
    """Return a compiler's options for an architecture."""
    return (*OPTIONS, f"--offload-arch={arch}", f"-DGS2D_WAVE={wave_of(arch)}")


def prepared(name: str) -> str:
    """Return a source as AMD's compilers take it."""
    return _FIRST + sources()[name]


def shipped_objects() -> Shipped | None:
    """Return the code objects that this installation brought; None where it has none, or sources were edited."""
    return shipped(gs2d.__version__, digest_of(sources(), OPTIONS), None, AMD_MANIFEST, "clang")


@cache
def ready_compiler() -> ctypes.CDLL:
    """Return hiprtc; the run-time library itself has it too, in some versions.

    Raises
    ------
    BackendError
        It is not here.
    """
    said = ""
    for stem in (COMPILER, RUNTIME):
        try:
            library = find_library(stem, "hiprtcCompileProgram")
        except OSError as error:
            said = said or str(error)
            continue
        library.hiprtcGetErrorString.restype = ctypes.c_char_p
        return library
    raise BackendError(f"AMD's compiler {COMPILER} is not here ({said}); {REMEDY}")


def compile_source(name: str, arch: str) -> tuple[bytes, str]:
    """Compile one file, always: the code object, and the compiler's log.

    Raises
    ------
    BackendError
        If hiprtc is missing, or refuses the source (with its first error).
    """
    hiprtc, program = ready_compiler(), ctypes.c_void_p()
    headers = {key: text for key, text in sources().items() if key.endswith(".h")}
    texts, names = _strings([*headers.values()]), _strings([*headers])
    given = (prepared(name).encode(), name.encode(), len(headers), texts, names)
    _check(hiprtc, hiprtc.hiprtcCreateProgram(ctypes.byref(program), *given), "hiprtcCreateProgram")
    try:
        options = options_for(arch)
        number = hiprtc.hiprtcCompileProgram(program, len(options), _strings(list(options)))
        log = _bytes(hiprtc, program, "ProgramLog").decode(errors="replace").rstrip("\0")
        if number != 0:
            first = next((line for line in log.splitlines() if "error" in line), _name_of(hiprtc, number))
            raise BackendError(f"AMD's compiler refused {name} for {arch}: {first.strip()}")
        return _bytes(hiprtc, program, "Code"), log
    finally:
        hiprtc.hiprtcDestroyProgram(ctypes.byref(program))


def code_object(name: str, arch: str, folder: Path | None = None) -> bytes:
    """Machine code of one file for one architecture: the package's own, from the cache, or compiled.

    Parameters
    ----------
    name : str
        ``"cuda/project.cu"``.
    arch : str
        ``"gfx942"``.
    folder : Path, optional
        Instead of :func:`gs2d.kernels.cuda.compile.cache_folder`.

    Raises
    ------
    BackendError
        As for :func:`compile_source`.
    """
    there = shipped_objects()
    brought = None if there is None else there.code(name, arch)
    if brought is not None:
        return brought
    key = digest_of(sources(), (gs2d.__version__, name, *options_for(arch)))[:32]
    stem = name.rpartition("/")[2].removesuffix(".cu")
    return kept_code(folder or cache_folder(), f"{stem}-{arch}-{key}.hsaco", lambda: compile_source(name, arch)[0])


def _strings(texts: list[str]) -> ctypes.Array[ctypes.c_char_p]:
    return (ctypes.c_char_p * len(texts))(*(text.encode() for text in texts))


def _name_of(hiprtc: ctypes.CDLL, number: int) -> str:
    return (hiprtc.hiprtcGetErrorString(number) or b"an error without a name").decode()


def _check(hiprtc: ctypes.CDLL, number: int, what: str) -> None:
    if number != 0:
        raise BackendError(f"AMD's compiler failed in {what} ({_name_of(hiprtc, number)}); {REMEDY}")


def _bytes(hiprtc: Any, program: ctypes.c_void_p, what: str) -> bytes:
    size = ctypes.c_size_t()
    _check(hiprtc, getattr(hiprtc, f"hiprtcGet{what}Size")(program, ctypes.byref(size)), f"hiprtcGet{what}Size")
    buffer = ctypes.create_string_buffer(max(size.value, 1))
    _check(hiprtc, getattr(hiprtc, f"hiprtcGet{what}")(program, buffer), f"hiprtcGet{what}")
    return buffer.raw[: size.value]
