"""Compile the CUDA kernels with NVRTC and keep the cubins.

No toolkit and no host compiler: NVRTC comes as a wheel, with torch or by itself. It is imported only when something
must be compiled: what the package brings (:mod:`gs2d.kernels.cuda.shipped`) or the cache holds is not. A cubin is
cached under a key of the package's version, its sources, the options and the architecture, so a changed package cannot
meet a stale one. It is written under another name and renamed, so that two
processes or a killed one leave nothing or a whole file; it carries a digest, so that a damaged one is compiled again.
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
from gs2d.kernels.cuda.shipped import INTEGRATED, SHIPPED, Shipped, digest_of
from gs2d.kernels.cuda.shipped import shipped as _shipped

__all__ = [
    "ARCHITECTURES",
    "Cubin",
    "KernelUsage",
    "architecture_for",
    "cache_folder",
    "compile_source",
    "compile_text",
    "cubin",
    "is_writable",
    "kernel_sources",
    "nvrtc_version",
    "shipped_kernels",
    "source_names",
    "sources",
]

ARCHITECTURES = SHIPPED
# --fmad=false: every fused multiply-add is written out in core/, so that forward, backward and CPU decide alike.
OPTIONS = ("--std=c++17", "--fmad=false", "--ptxas-options=-v", "--device-as-default-execution-space")
REMEDY = "pip install nvidia-cuda-nvrtc cuda-bindings (torch's CUDA wheels bring both), or use --backend cpu"
DIGEST_BYTES = 32
MIN_CAPABILITY = (7, 5)
KERNEL = re.compile(r'extern "C" __global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\(')


@dataclass(frozen=True)
class KernelUsage:
    """What ptxas says about one kernel.

    Attributes
    ----------
    registers : int
        Per thread.
    spilled_bytes, stack_bytes : int
        Local memory per thread, stores and loads of spills together; 0 in a healthy kernel.
    shared_bytes : int
        Per block.
    """

    registers: int
    spilled_bytes: int
    stack_bytes: int
    shared_bytes: int


@dataclass(frozen=True)
class Cubin:
    """Machine code for one architecture (PTX for ``compute_XX``), and the compiler's log ("" where it was cached)."""

    code: bytes
    log: str

    def usage(self) -> dict[str, KernelUsage]:
        """Return registers, spills, stack and shared memory of each kernel, from the log."""
        found: dict[str, KernelUsage] = {}
        for part in self.log.split("Compiling entry function '")[1:]:
            found[part.partition("'")[0]] = KernelUsage(
                registers=_number(r"Used (\d+) registers", part),
                spilled_bytes=_number(r"(\d+) bytes spill stores", part) + _number(r"(\d+) bytes spill loads", part),
                stack_bytes=_number(r"(\d+) bytes stack frame", part),
                shared_bytes=_number(r"(\d+) bytes smem", part, missing=0),
            )
        return found


def _number(pattern: str, text: str, missing: int | None = None) -> int:
    match = re.search(pattern, text)
    if match is None:
        if missing is not None:
            return missing
        raise BackendError(f"the CUDA compiler's log has no {pattern!r}: expected the format of CUDA 12 or 13")
    return int(match.group(1))


def sources() -> dict[str, str]:
    """All sources by the name under which they include each other (``core/base.h``, ``cuda/project.cu``)."""
    root = resources.files("gs2d.kernels")
    found = {}
    for folder in ("core", "cuda"):
        for entry in sorted(root.joinpath(folder).iterdir(), key=lambda e: e.name):
            if entry.name.endswith((".h", ".cu")):
                found[f"{folder}/{entry.name}"] = entry.read_text(encoding="utf-8")
    return found


def source_names() -> tuple[str, ...]:
    """Return the files that hold kernels: ``cuda/project.cu`` and so on."""
    return tuple(name for name in sources() if name.endswith(".cu"))


def kernel_sources() -> dict[str, str]:
    """Return the file of each kernel: ``{"project_splats": "cuda/project.cu", ...}``."""
    return {kernel: name for name, text in sources().items() if name.endswith(".cu") for kernel in KERNEL.findall(text)}


def shipped_kernels() -> Shipped | None:
    """Return the machine code that this installation brought; None where it has none, or sources were edited."""
    return _shipped(gs2d.__version__, digest_of(sources(), OPTIONS))


def _nvrtc() -> Any:
    try:
        from cuda.bindings import nvrtc

        _check(nvrtc, nvrtc.nvrtcVersion()[0], "nvrtcVersion")  # finds the library only now
    except (ImportError, RuntimeError, OSError) as error:
        raise BackendError(f"the CUDA compiler NVRTC is not here ({error}); {REMEDY}") from error
    return nvrtc


def _check(nvrtc: Any, status: Any, what: str) -> None:
    if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        raise BackendError(f"the CUDA compiler failed in {what} ({status.name}); {REMEDY}")


def nvrtc_version() -> tuple[int, int]:
    """Of the compiler, (major, minor).

    Raises
    ------
    BackendError
        NVRTC is missing.
    """
    nvrtc = _nvrtc()
    status, major, minor = nvrtc.nvrtcVersion()
    _check(nvrtc, status, "nvrtcVersion")
    return int(major), int(minor)


def architecture_for(capability: tuple[int, int]) -> str:
    """Return what to compile for on a device of this compute capability: ``(9, 0)`` -> ``"sm_90"``.

    What the package brings comes first, and needs no compiler. A device newer than the compiler runs code for an older
    one of the same major version. Of a major version that the compiler does not know it gets ``"compute_120"``, PTX of
    the newest known one, which the driver translates. Without a compiler it is what the cache may hold.

    Raises
    ------
    BackendError
        The device is too old, or between what NVRTC knows.
    """
    if capability < MIN_CAPABILITY:
        raise BackendError(
            f"the GPU must have compute capability 7.5 or more (Turing, 2018), got {capability[0]}.{capability[1]}; "
            "use --backend cpu"
        )
    there = shipped_kernels()
    brought = None if there is None else there.architecture_for(capability)
    if brought is not None:
        return brought
    known = _known_architectures()
    wanted = 10 * capability[0] + capability[1]
    older = [arch for arch in known if arch <= wanted and (arch == wanted or arch not in INTEGRATED)]
    fitting = [arch for arch in older if arch // 10 == wanted // 10]
    if fitting:
        return f"sm_{max(fitting)}"
    if not older:
        raise BackendError(
            f"the CUDA compiler knows architectures from sm_{min(known)}, the GPU has compute capability "
            f"{capability[0]}.{capability[1]}; install the NVRTC of torch's CUDA version"
        )
    return f"compute_{max(older)}"


def _known_architectures() -> list[int]:
    """Of the compiler; without one those for which this package is compiled somewhere."""
    try:
        nvrtc = _nvrtc()
    except BackendError:
        return [int(arch.removeprefix("sm_")) for arch in ARCHITECTURES]
    status, known = nvrtc.nvrtcGetSupportedArchs()
    _check(nvrtc, status, "nvrtcGetSupportedArchs")
    return [int(arch) for arch in known]


def compile_source(name: str, arch: str, options: Sequence[str] = OPTIONS) -> Cubin:
    """Compile one file, always.

    Parameters
    ----------
    name : str
        One of :func:`source_names`.
    arch : str
        ``"sm_90"`` and the like, or ``"compute_90"`` for PTX.
    options : sequence of str
        NVRTC options besides the architecture.

    Raises
    ------
    BackendError
        If NVRTC is missing, does not know the architecture, or refuses the source (with its first error).
    """
    files = sources()
    headers = {key: text for key, text in files.items() if key.endswith(".h")}
    return compile_text(files[name], name, arch, headers=headers, options=options)


def compile_text(
    text: str, name: str, arch: str, *, headers: Mapping[str, str] | None = None, options: Sequence[str] = OPTIONS
) -> Cubin:
    """Compile a source that is not of the package (the benchmarks' probes).

    Parameters
    ----------
    text, name : str
        The source, and what the compiler calls it.
    arch, options
        As for :func:`compile_source`.
    headers : mapping of str to str
        What it may include, by name.

    Raises
    ------
    BackendError
        As for :func:`compile_source`.
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
        given = [f"--gpu-architecture={arch}".encode(), *(option.encode() for option in options)]
        (status,) = nvrtc.nvrtcCompileProgram(program, len(given), given)
        log = _bytes(nvrtc, program, "ProgramLog").decode(errors="replace").rstrip("\0")
        if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
            first = next((line for line in log.splitlines() if "error" in line), status.name)
            raise BackendError(f"the CUDA compiler refused {name} for {arch}: {first.strip()}")
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
    """``$GS2D_CACHE``, else ``$XDG_CACHE_HOME/gs2d``, else ``~/.cache/gs2d``; it need not exist. None without a home.

    A user without a home (a number without a name, as containers have) compiles at every start: a folder that others
    may write to is no place for what is executed.
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
    """Whether cubins can be kept there; nothing is written."""
    if folder is None:
        return False
    there = next((part for part in (folder, *folder.parents) if part.exists()), None)
    return there is not None and there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _key(name: str, arch: str) -> str:
    """Of the package's version and everything else that the machine code depends on but for the compiler's version."""
    return digest_of(sources(), (gs2d.__version__, name, arch, *OPTIONS))[:32]


def cubin(name: str, arch: str, folder: Path | None = None) -> Cubin:
    """Machine code of one file for one architecture: the package's own, from the cache, or compiled.

    A cache that cannot be read or written costs compile time, nothing else: a read-only home must not stop training.

    Parameters
    ----------
    name, arch
        As for :func:`compile_source`.
    folder : Path, optional
        Instead of :func:`cache_folder`.

    Raises
    ------
    BackendError
        As for :func:`compile_source`.
    """
    stem = name.rpartition("/")[2].removesuffix(".cu")
    there = shipped_kernels()
    brought = None if there is None else there.code(name, arch)
    if brought is not None:
        return Cubin(brought, "")
    folder = folder or cache_folder()
    path = None if folder is None else folder / f"{stem}-{arch}-{_key(name, arch)}.cubin"
    code = None if path is None else _read(path)
    if code is not None:
        return Cubin(code, "")
    made = compile_source(name, arch)
    if path is not None:
        _write(path, made.code)
    return made


def _read(path: Path) -> bytes | None:
    """Return the code of a whole file; None where there is none, or not a whole one."""
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
