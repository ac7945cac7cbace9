"""Whether this machine can run the CUDA kernels, and the first thing that is missing if not.

Facts are gathered first and judged afterwards, in the order in which a user would have to mend them.
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

__all__ = ["Facts", "MissingFile", "describe", "gather", "missing"]

ANYWAY = "or use --backend cpu"
OLDEST_CUDA = (12, 0)  # the driver's functions that load kernels for every device at once are of that version


@dataclass(frozen=True)
class Facts:
    """What the CUDA backend needs of a machine, as found.

    Attributes
    ----------
    torch_version : str
    torch_cuda : (int, int) or None
        The CUDA version that torch was built with; None = built without.
    bindings_error, nvrtc_error, driver_error : str
        Why each cannot be used; "" where it can.
    nvrtc, driver : (int, int) or None
        CUDA versions of the compiler, and the newest that the driver supports.
    devices : tuple of (str, (int, int))
        Name and compute capability of every device that torch sees, the current one first.
    torch_error : str
        What torch said when it was asked for devices.
    architecture_error : str
        Why nothing can be compiled for the current device; "" where it can.
    cache : Path or None
        Where machine code is kept; None where there is no home.
    cache_writable : bool
    shipped : (int, int) or None
        CUDA version of the machine code that the package brought for the current device; None: it has none.
    own_default_stream : bool
        Whether the bindings were told to take torch's default stream for another one.
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
    shipped: tuple[int, int] | None = None


@dataclass(frozen=True)
class MissingFile:
    """The first thing that is missing, and what to do about it."""

    reason: str
    remedy: str


def missing(facts: Facts) -> MissingFile | None:
    """Return what keeps the backend from running; None if nothing does."""
    if facts.torch_cuda is None:
        return MissingFile(
            f"torch {facts.torch_version} is built without CUDA",
            f"install a CUDA build of torch (on Linux plain `pip install torch` brings one), {ANYWAY}",
        )
    if facts.torch_cuda < OLDEST_CUDA:
        return MissingFile(
            f"torch is built for CUDA {dotted(facts.torch_cuda)}, CUDA 12 or newer is needed",
            f"install a torch build for CUDA 12 or 13, {ANYWAY}",
        )
    if facts.bindings_error:
        return MissingFile(
            f"the Python package cuda.bindings is not here ({facts.bindings_error})", _install(facts.torch_cuda[0])
        )
    if facts.nvrtc_error and facts.shipped is None:
        return MissingFile(f"the CUDA compiler NVRTC is not here ({facts.nvrtc_error})", _install(facts.torch_cuda[0]))
    if facts.driver_error or facts.driver is None:
        return MissingFile(f"no NVIDIA driver is here ({facts.driver_error})", DRIVER_REMEDY)
    compiler = facts.nvrtc if facts.shipped is None else facts.shipped
    for name, needs in (("torch", facts.torch_cuda), ("NVRTC" if facts.shipped is None else "gs2d", compiler)):
        if needs is not None and facts.driver[0] < needs[0]:  # within a major version newer code runs on older drivers
            return MissingFile(
                f"the driver supports CUDA {dotted(facts.driver)}, but {name} is of CUDA {dotted(needs)}",
                f"{OLD_DRIVER}, {ANYWAY}",
            )
    if not facts.devices:
        said = f" ({facts.torch_error})" if facts.torch_error else ""
        return MissingFile(f"torch sees no CUDA device{said}", f"check `nvidia-smi` and CUDA_VISIBLE_DEVICES, {ANYWAY}")
    if facts.own_default_stream:
        return MissingFile(f"{PER_THREAD} is set: kernels would run beside torch's work, not after it", "unset it")
    if facts.architecture_error:
        reason, _, remedy = facts.architecture_error.partition("; ")
        return MissingFile(f"{facts.devices[0][0]}: {reason}", remedy)
    return None


def _install(major: int) -> str:
    """How to get bindings and compiler of the CUDA version of torch: a mixture does not find its libraries."""
    extra = f"cuda{major}"
    if extra not in EXTRAS:
        return f"install the cuda-bindings and the NVRTC of CUDA {major}, {ANYWAY}"
    return f"{install(extra)} (the extra {extra}; torch's CUDA wheels bring the compiler), {ANYWAY}"


def describe(facts: Facts) -> str:
    """One line about a machine that can run the backend."""
    names = [f"{name} (sm_{major}{minor})" for name, (major, minor) in facts.devices]
    compiler = f"NVRTC {dotted(facts.nvrtc)}"
    if facts.shipped is not None:
        return f"{', '.join(names)}; driver CUDA {dotted(facts.driver)}, kernels of the package"
    versions = f"driver CUDA {dotted(facts.driver)}, {compiler}"
    return f"{', '.join(names)}; {versions}{cache_words(facts.cache, facts.cache_writable)}"


def cache_words(cache: Path | None, writable: bool) -> str:
    """Return what to say of a cache that keeps nothing."""
    if writable:
        return ""
    where = "there is no home folder (set GS2D_CACHE)" if cache is None else f"{cache} cannot be written"
    return f"; {where}: kernels are compiled at every start"


def report() -> tuple[MissingFile | None, str]:
    """Return what keeps the backend from running here, and a line about the machine where nothing does."""
    facts = gather()
    lacking = missing(facts)
    return lacking, "" if lacking is not None else describe(facts)


def gather() -> Facts:
    """Return the facts of this machine; only the first where torch is built without CUDA. Makes no context on a GPU."""
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
    shipped = nvrtc.shipped_kernels()
    if shipped is not None and (not devices or shipped.architecture_for(devices[0][1]) is None):
        shipped = None
    if devices and (compiler is not None or shipped is not None):
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
        None if shipped is None else shipped.compiler,
    )


def seen_devices() -> tuple[tuple[tuple[str, tuple[int, int]], ...], str]:
    """Return devices that torch sees, the current one first, and what it said where it sees none."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        usable = torch.cuda.is_available()
    if not usable:
        return (), str(said[0].message).splitlines()[0] if said else ""
    first = torch.cuda.current_device()
    order = sorted(range(torch.cuda.device_count()), key=lambda index: index != first)
    return tuple((torch.cuda.get_device_name(i), torch.cuda.get_device_capability(i)) for i in order), ""


def version_of(text: str) -> tuple[int, int]:
    """Return (6, 2) of "6.2.41133"."""
    major, _, rest = text.partition(".")
    return int(major), int(rest.partition(".")[0] or 0)


def dotted(version: tuple[int, int] | None) -> str:
    """Return "6.2" of (6, 2)."""
    return "?" if version is None else f"{version[0]}.{version[1]}"


def inner(error: BackendError) -> str:
    """Return what lies between the brackets of an error's message: the library's own words, one line of them."""
    text = str(error.__cause__ if error.__cause__ is not None else error).strip().splitlines()
    return text[0] if text else type(error).__name__
