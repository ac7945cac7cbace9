"""Compile the CUDA kernels with NVRTC and cache the cubins.

This needs neither the CUDA toolkit nor a host compiler: NVRTC comes as a wheel, with torch or by itself. It is imported
only for kernels that are not cached. The cache key covers the package version, sources, options and architecture, so a
changed package never loads a stale cubin. Cubins are written to a temporary name and renamed, so no process sees a
partial file, and carry a digest, so damaged ones are recompiled.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import gs2d
from gs2d.core.atomic_files import atomic_write
from gs2d.errors import BackendError, DiskError
from gs2d.kernels.cuda.driver import one_line

ARCHITECTURES = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")
# GPUs integrated with a CPU (Xavier, Orin, Thor): their code and that of other GPUs of the same major version are not
# compatible.
INTEGRATED = frozenset({72, 87, 88, 101, 110})
# --fmad=false: core/ writes out every fused multiply-add, so that forward, backward and CPU take the same branches.
OPTIONS = ("--std=c++17", "--fmad=false", "--ptxas-options=-v", "--device-as-default-execution-space")
REMEDY = "pip install nvidia-cuda-nvrtc cuda-bindings (torch's CUDA wheels bring both), or use --backend cpu"
DIGEST_BYTES = 32
MIN_CAPABILITY = (7, 5)
KERNEL = re.compile(r'extern "C" __global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\(')


@dataclass(frozen=True)
class Cubin:
    """Machine code for one architecture (PTX for ``compute_XX``), and the compiler's log ("" if it was cached)."""

    code: bytes
    log: str


def sources() -> dict[str, str]:
    """Return all sources by their name in includes (``core/base.h``, ``cuda/project.cu``)."""
    root = resources.files("gs2d.kernels")
    texts = {}
    for folder in ("core", "cuda"):
        for entry in sorted(root.joinpath(folder).iterdir(), key=lambda e: e.name):
            if entry.name.endswith((".h", ".cu")):
                texts[f"{folder}/{entry.name}"] = entry.read_text(encoding="utf-8")
    return texts


def source_names() -> tuple[str, ...]:
    """Return the names of the files with kernels, such as ``cuda/project.cu``."""
    return tuple(name for name in sources() if name.endswith(".cu"))


def kernel_sources() -> dict[str, str]:
    """Return the file of each kernel: ``{"project_splats": "cuda/project.cu", ...}``."""
    return {kernel: name for name, text in sources().items() if name.endswith(".cu") for kernel in KERNEL.findall(text)}


def _nvrtc() -> Any:
    try:
        from cuda.bindings import nvrtc

        _check(nvrtc, nvrtc.nvrtcVersion()[0], "nvrtcVersion")  # loads the library
    except (ImportError, RuntimeError, OSError) as error:
        raise BackendError(f"the CUDA compiler NVRTC is missing ({one_line(error)}); {REMEDY}") from error
    return nvrtc


def _check(nvrtc: Any, status: Any, what: str) -> None:
    if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        raise BackendError(f"the CUDA compiler failed in {what} ({status.name}); {REMEDY}")


def nvrtc_version() -> tuple[int, int]:
    """Return the version of NVRTC, (major, minor); BackendError if it is missing."""
    nvrtc = _nvrtc()
    status, major, minor = nvrtc.nvrtcVersion()
    _check(nvrtc, status, "nvrtcVersion")
    return int(major), int(minor)


def architecture_for(capability: tuple[int, int]) -> str:
    """Return the architecture to compile for on a device of this compute capability: ``(9, 0)`` -> ``"sm_90"``.

    A device newer than the compiler runs code for an older one of the same major version. For a newer major version the
    result is PTX of the newest supported architecture, such as ``"compute_120"``, which the driver translates. Without
    a compiler it is an architecture that the cache may hold. Raises BackendError if no architecture fits the device.
    """
    if capability < MIN_CAPABILITY:
        raise BackendError(
            f"the GPU must have compute capability 7.5 or more (Turing, 2018), got {capability[0]}.{capability[1]}; "
            "use --backend cpu"
        )
    supported = _supported_architectures()
    exact = 10 * capability[0] + capability[1]
    older = [arch for arch in supported if arch <= exact and (arch == exact or arch not in INTEGRATED)]
    fitting = [arch for arch in older if arch // 10 == exact // 10]
    if fitting:
        return f"sm_{max(fitting)}"
    if not older:
        raise BackendError(
            f"the CUDA compiler knows architectures from sm_{min(supported)}, the GPU has compute capability "
            f"{capability[0]}.{capability[1]}; install the NVRTC of torch's CUDA version"
        )
    return f"compute_{max(older)}"


def _supported_architectures() -> list[int]:
    """Return the architectures that the compiler supports; without a compiler, ``ARCHITECTURES``."""
    try:
        nvrtc = _nvrtc()
    except BackendError:
        return [int(arch.removeprefix("sm_")) for arch in ARCHITECTURES]
    status, supported = nvrtc.nvrtcGetSupportedArchs()
    _check(nvrtc, status, "nvrtcGetSupportedArchs")
    return [int(arch) for arch in supported]


def compile_source(name: str, arch: str, options: Sequence[str] = OPTIONS) -> Cubin:
    """Compile one of :func:`source_names`, without the cache.

    The architecture is one of GPUs, such as ``"sm_90"``, or of PTX, such as ``"compute_90"``. ``options`` are those of
    NVRTC, without the architecture. Raises BackendError if NVRTC is missing, does not know the architecture, or rejects
    the source (with its first error).
    """
    files = sources()
    headers = {key: text for key, text in files.items() if key.endswith(".h")}
    return compile_text(files[name], name, arch, headers=headers, options=options)


def compile_text(
    text: str, name: str, arch: str, *, headers: Mapping[str, str] | None = None, options: Sequence[str] = OPTIONS
) -> Cubin:
    """Compile a source that is not part of the package (the benchmarks' probes).

    ``name`` is for messages, ``headers`` are the files that it may include, by name. The others are as for
    :func:`compile_source`.
    """
    nvrtc = _nvrtc()
    headers = {} if headers is None else headers
    status, program = nvrtc.nvrtcCreateProgram(
        text.encode(),
        name.encode(),
        len(headers),
        [t.encode() for t in headers.values()],
        [k.encode() for k in headers],
    )
    _check(nvrtc, status, "nvrtcCreateProgram")
    try:
        flags = [f"--gpu-architecture={arch}".encode(), *(option.encode() for option in options)]
        (status,) = nvrtc.nvrtcCompileProgram(program, len(flags), flags)
        log = _bytes(nvrtc, program, "ProgramLog").decode(errors="replace").rstrip("\0")
        if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
            first = next((line for line in log.splitlines() if "error" in line), status.name)
            raise BackendError(f"the CUDA compiler rejected {name} for {arch}: {first.strip()}")
        return Cubin(_bytes(nvrtc, program, "PTX" if arch.startswith("compute_") else "CUBIN"), log)
    finally:
        nvrtc.nvrtcDestroyProgram(program)


def _bytes(nvrtc: Any, program: Any, what: str) -> bytes:
    status, size = getattr(nvrtc, f"nvrtcGet{what}Size")(program)
    _check(nvrtc, status, f"nvrtcGet{what}Size")
    buffer = b"\0" * size
    (status,) = getattr(nvrtc, f"nvrtcGet{what}")(program, buffer)
    _check(nvrtc, status, f"nvrtcGet{what}")
    return buffer


def cache_folder() -> Path | None:
    """Return ``$GS2D_CACHE``, else ``$XDG_CACHE_HOME/gs2d``, else ``~/.cache/gs2d``, existing or not.

    None for a user without a home folder, as in some containers: then kernels are compiled at every start, since
    executable code does not belong into a folder that others can write to.
    """
    named = os.environ.get("GS2D_CACHE")
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path("~/.cache").expanduser()) / "gs2d"
    except RuntimeError:
        return None


def is_writable(folder: Path | None) -> bool:
    """Whether cubins can be cached in a folder; writes nothing."""
    if folder is None:
        return False
    there = next((part for part in (folder, *folder.parents) if part.exists()), None)
    return there is not None and there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _key(name: str, arch: str) -> str:
    """Return the cache key: all that the machine code depends on except the compiler's version."""
    digest = hashlib.sha256()
    texts = (text for pair in sorted(sources().items()) for text in pair)
    for part in (gs2d.__version__, name, arch, *OPTIONS, *texts):
        data = part.encode()
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()[:32]


def cubin(name: str, arch: str, folder: Path | None = None) -> Cubin:
    """Return the machine code of one file for one architecture: cached, or compiled.

    The folder of the cache is :func:`cache_folder` by default. A cache that cannot be read or written only costs
    compile time.
    """
    stem = name.rpartition("/")[2].removesuffix(".cu")
    folder = folder or cache_folder()
    path = None if folder is None else folder / f"{stem}-{arch}-{_key(name, arch)}.cubin"
    code = None if path is None else _read(path)
    if code is not None:
        return Cubin(code, "")
    compiled = compile_source(name, arch)
    if path is not None:
        _write(path, compiled.code)
    return compiled


def _read(path: Path) -> bytes | None:
    """Return the code in a cached file; None if it is missing or damaged."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    code = data[DIGEST_BYTES:]
    return code if code and hashlib.sha256(code).digest() == data[:DIGEST_BYTES] else None


def _write(path: Path, code: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as file:
            file.write(hashlib.sha256(code).digest() + code)
    except (OSError, DiskError):
        return
