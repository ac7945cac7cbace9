"""Diagnosis of a machine for the CUDA kernels: whether it can run them, and if not, what to fix first.

Facts are gathered first and checked afterwards, in the order in which a user would fix them.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import torch

from gs2d.core.extras import EXTRAS, install
from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda.driver import (
    DRIVER_REMEDY,
    OLD_DRIVER,
    PER_THREAD,
    driver_version,
    load_driver,
    own_default_stream,
)

__all__ = ["Facts", "Obstacle", "describe", "gather", "missing"]

ANYWAY = "or use --backend cpu"
OLDEST_CUDA = (12, 0)  # first version that loads kernels for all devices at once


@dataclass(frozen=True)
class Facts:
    """Properties of a machine that matter to the CUDA backend.

    Attributes
    ----------
    torch_version : str
    torch_cuda : (int, int) or None
        CUDA version of the torch build; None: built without CUDA.
    bindings_error, nvrtc_error, driver_error : str
        Why each cannot be used; "" if it can.
    nvrtc, driver : (int, int) or None
        CUDA version of the compiler, and the newest CUDA version that the driver supports.
    devices : tuple of (str, (int, int))
        Name and compute capability of each device visible to torch, the current one first.
    torch_error : str
        torch's warning if it finds no device.
    architecture_error : str
        Why nothing can be compiled for the current device; "" if it can.
    cache : Path or None
        Folder of cached machine code; None without a home folder.
    cache_writable : bool
    own_default_stream : bool
        Whether cuda.bindings uses a default stream of its own instead of torch's.
    """

    torch_version: str
    torch_cuda: tuple[int, int] | None
    bindings_error: str = ""
    nvrtc_error: str = ""
    nvrtc: tuple[int, int] | None = None
    driver_error: str = ""
    driver: tuple[int, int] | None = None
    devices: tuple[tuple[str, tuple[int, int]], ...] = ()
    torch_error: str = ""
    architecture_error: str = ""
    cache: Path | None = Path()
    cache_writable: bool = True
    own_default_stream: bool = False


@dataclass(frozen=True)
class Obstacle:
    """Why the backend cannot run, and the remedy."""

    reason: str
    remedy: str


def missing(facts: Facts) -> Obstacle | None:
    """Return the first obstacle, None if the backend can run."""
    if facts.torch_cuda is None:
        return Obstacle(
            f"torch {facts.torch_version} is built without CUDA",
            f"install a CUDA build of torch (on Linux plain `pip install torch` brings one), {ANYWAY}",
        )
    if facts.torch_cuda < OLDEST_CUDA:
        return Obstacle(
            f"torch is built for CUDA {dotted(facts.torch_cuda)}, CUDA 12 or newer is needed",
            f"install a torch build for CUDA 12 or 13, {ANYWAY}",
        )
    if facts.bindings_error:
        return Obstacle(
            f"the Python package cuda.bindings is missing ({facts.bindings_error})", _install(facts.torch_cuda[0])
        )
    if facts.nvrtc_error:
        return Obstacle(f"the CUDA compiler NVRTC is missing ({facts.nvrtc_error})", _install(facts.torch_cuda[0]))
    if facts.driver_error or facts.driver is None:
        return Obstacle(f"no NVIDIA driver is installed ({facts.driver_error})", DRIVER_REMEDY)
    for name, needs in (("torch", facts.torch_cuda), ("NVRTC", facts.nvrtc)):
        if needs is not None and facts.driver[0] < needs[0]:  # within a major version newer code runs on older drivers
            return Obstacle(
                f"the driver supports CUDA {dotted(facts.driver)}, but {name} needs CUDA {dotted(needs)}",
                f"{OLD_DRIVER}, {ANYWAY}",
            )
    if not facts.devices:
        said = f" ({facts.torch_error})" if facts.torch_error else ""
        return Obstacle(f"torch sees no CUDA device{said}", f"check `nvidia-smi` and CUDA_VISIBLE_DEVICES, {ANYWAY}")
    if facts.own_default_stream:
        return Obstacle(f"{PER_THREAD} is set: kernels would run beside torch's work, not after it", "unset it")
    if facts.architecture_error:
        reason, _, remedy = facts.architecture_error.partition("; ")
        return Obstacle(f"{facts.devices[0][0]}: {reason}", remedy)
    return None


def _install(major: int) -> str:
    """Return how to install bindings and compiler with torch's CUDA version; other versions do not find each other."""
    extra = f"cuda{major}"
    if extra not in EXTRAS:
        return f"install the cuda-bindings and the NVRTC of CUDA {major}, {ANYWAY}"
    return f"{install(extra)} (the extra {extra}; torch's CUDA wheels bring the compiler), {ANYWAY}"


def describe(facts: Facts) -> str:
    """Return a line about a machine that can run the backend."""
    names = [f"{name} (sm_{major}{minor})" for name, (major, minor) in facts.devices]
    versions = f"driver CUDA {dotted(facts.driver)}, NVRTC {dotted(facts.nvrtc)}"
    return f"{', '.join(names)}; {versions}{cache_words(facts.cache, facts.cache_writable)}"


def cache_words(cache: Path | None, writable: bool) -> str:
    """Return a note about a cache that cannot be written, "" if it can."""
    if writable:
        return ""
    where = "there is no home folder (set GS2D_CACHE)" if cache is None else f"{cache} cannot be written"
    return f"; {where}: kernels are compiled at every start"


def report() -> tuple[Obstacle | None, str]:
    """Return the first obstacle on this machine, or None with a line about the machine."""
    facts = gather()
    lacking = missing(facts)
    return lacking, "" if lacking is not None else describe(facts)


def gather() -> Facts:
    """Return the facts of this machine without creating a GPU context; only the first without a CUDA build of torch."""
    cuda = torch.version.cuda
    if cuda is None:
        return Facts(torch.__version__, None)
    bindings_error = nvrtc_error = driver_error = architecture_error = ""
    compiler = driver = None
    try:
        bindings = load_driver()
    except BackendError as error:
        bindings_error = inner(error)
    else:
        try:
            driver = driver_version(bindings)
        except BackendError as error:
            driver_error = inner(error)
    try:
        compiler = nvrtc.nvrtc_version()
    except BackendError as error:
        nvrtc_error = inner(error)
    devices, torch_error = seen_devices()
    if devices and compiler is not None:
        try:
            nvrtc.architecture_for(devices[0][1])
        except BackendError as error:
            architecture_error = str(error)
    folder = nvrtc.cache_folder()
    return Facts(
        torch.__version__,
        version_of(cuda),
        bindings_error,
        nvrtc_error,
        compiler,
        driver_error,
        driver,
        devices,
        torch_error,
        architecture_error,
        folder,
        nvrtc.is_writable(folder),
        own_default_stream(),
    )


def seen_devices() -> tuple[tuple[tuple[str, tuple[int, int]], ...], str]:
    """Return the devices visible to torch, the current one first, and torch's warning if there are none."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        usable = torch.cuda.is_available()
    if not usable:
        return (), str(said[0].message).splitlines()[0] if said else ""
    first = torch.cuda.current_device()
    order = sorted(range(torch.cuda.device_count()), key=lambda index: index != first)
    return tuple((torch.cuda.get_device_name(i), torch.cuda.get_device_capability(i)) for i in order), ""


def version_of(text: str) -> tuple[int, int]:
    """Parse a version: "6.2.41133" -> (6, 2)."""
    major, _, rest = text.partition(".")
    return int(major), int(rest.partition(".")[0] or 0)


def dotted(version: tuple[int, int] | None) -> str:
    """Format a version: (6, 2) -> "6.2"."""
    return "?" if version is None else f"{version[0]}.{version[1]}"


def inner(error: BackendError) -> str:
    """Return the first line of the library's own error message."""
    text = str(error.__cause__ if error.__cause__ is not None else error).strip().splitlines()
    return text[0] if text else type(error).__name__
