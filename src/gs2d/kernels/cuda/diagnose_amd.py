"""Whether this machine can run the kernels on an AMD GPU, and the first thing that is missing if not.

As :mod:`gs2d.kernels.cuda.diagnose`, where torch is built for ROCm.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda import hiprtc
from gs2d.kernels.cuda.diagnose import ANYWAY, MissingFile, cache_words, dotted, inner, seen_devices, version_of
from gs2d.kernels.cuda.driver import driver_version
from gs2d.kernels.cuda.hip import load_hip

__all__ = ["AmdFacts", "describe", "gather", "missing"]

OLDEST_ROCM = (6, 0)  # an older compiler ends the process where it does not know the GPU
UNSEEN = "compiled and emulated, never yet tried on an AMD GPU"


@dataclass(frozen=True)
class AmdFacts:
    """What the CUDA backend needs of a machine with an AMD GPU, as found.

    Attributes
    ----------
    torch_version : str
    torch_hip : (int, int)
        The version of HIP, and so of ROCm, that torch was built with.
    hip_error, compiler_error : str
        Why run-time library and compiler cannot be used; "" where they can.
    hip : (int, int) or None
        Version of the run-time library.
    devices : tuple of str
        Names of what torch sees, the current one first.
    torch_error : str
        What torch said when it was asked for devices.
    arch : str
        Of the current device: "gfx942"; "" where there is none, and ``architecture_error`` why.
    architecture_error : str
    shipped : bool
        Whether the package brought code objects for it.
    cache : Path or None
    cache_writable : bool
    """

    torch_version: str
    torch_hip: tuple[int, int]
    hip_error: str = ""
    compiler_error: str = ""
    hip: tuple[int, int] | None = None
    devices: tuple[str, ...] = ()
    torch_error: str = ""
    arch: str = ""
    architecture_error: str = ""
    shipped: bool = False
    cache: Path | None = Path()
    cache_writable: bool = True


def missing(facts: AmdFacts) -> MissingFile | None:
    """Return what keeps the backend from running; None if nothing does."""
    if facts.torch_hip < OLDEST_ROCM:
        return MissingFile(
            f"torch is built for ROCm {dotted(facts.torch_hip)}, ROCm 6 or newer is needed",
            f"install a torch build for ROCm 6 or 7, {ANYWAY}",
        )
    if facts.hip_error or facts.hip is None:
        return MissingFile(
            f"AMD's run-time library cannot be used ({facts.hip_error})",
            f"install AMD's driver and torch's build for ROCm (`rocminfo` must list the GPU), {ANYWAY}",
        )
    if not facts.devices:
        said = f" ({facts.torch_error})" if facts.torch_error else ""
        return MissingFile(f"torch sees no AMD GPU{said}", f"check `rocminfo` and HIP_VISIBLE_DEVICES, {ANYWAY}")
    if facts.architecture_error:
        reason, _, remedy = facts.architecture_error.partition("; ")
        return MissingFile(f"{facts.devices[0]}: {reason}", remedy)
    if facts.compiler_error and not facts.shipped:
        return MissingFile(
            f"AMD's compiler hiprtc is not here ({facts.compiler_error})", f"install torch's build for ROCm, {ANYWAY}"
        )
    return None


def describe(facts: AmdFacts) -> str:
    """One line about a machine that should be able to run the backend."""
    made = "kernels of the package" if facts.shipped else "hiprtc"
    kept = "" if facts.shipped else cache_words(facts.cache, facts.cache_writable)
    names = ", ".join(facts.devices)
    return f"{names} (the first: {facts.arch}); ROCm {dotted(facts.hip)}, {made}{kept}; {UNSEEN}"


def gather() -> AmdFacts:
    """Return the facts of this machine, where torch is built for ROCm."""
    hip_error = compiler_error = architecture_error = arch = ""
    version = None
    try:
        version = driver_version(load_hip())
    except BackendError as error:
        hip_error = inner(error)
    try:
        hiprtc.ready_compiler()
    except BackendError as error:
        compiler_error = inner(error)
    devices, torch_error = seen_devices()
    if devices:
        try:
            arch = hiprtc.architecture_of(torch.device("cuda", torch.cuda.current_device()))
        except BackendError as error:
            architecture_error = str(error)
    there = hiprtc.shipped_objects()
    folder = nvrtc.cache_folder()
    return AmdFacts(
        torch.__version__,
        version_of(torch.version.hip or "0"),
        hip_error,
        compiler_error,
        version,
        tuple(name for name, _ in devices),
        torch_error,
        arch,
        architecture_error,
        there is not None and arch in there.architectures,
        folder,
        nvrtc.is_writable(folder),
    )
