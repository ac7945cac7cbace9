"""Diagnosis of a machine for the CUDA kernels: whether it can run them, and if not, what to fix first."""

from __future__ import annotations

import warnings

import torch

from gs2d.core.extras import EXTRAS, install
from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda.driver import OLD_DRIVER, PER_THREAD, driver_version, load_driver, own_default_stream

ANYWAY = "or use --backend cpu"
OLDEST_CUDA = (12, 0)  # first version that loads kernels for all devices at once


def machine() -> str:
    """Return a line about a machine that can run the kernels, without creating a GPU context.

    Raises BackendError with the first obstacle, in the order in which a user would fix them, and after "; " its remedy.
    """
    if torch.version.cuda is None:
        raise BackendError(
            f"torch {torch.__version__} is built without CUDA; install a CUDA build of torch (on Linux plain "
            f"`pip install torch` brings one), {ANYWAY}"
        )
    cuda = version_of(torch.version.cuda)
    if cuda < OLDEST_CUDA:
        raise BackendError(
            f"torch is built for CUDA {dotted(cuda)}, CUDA 12 or newer is needed; install a torch build for CUDA 12 or "
            f"13, {ANYWAY}"
        )
    try:
        driver, compiler = load_driver(), nvrtc.nvrtc_version()
    except BackendError as error:
        raise BackendError(f"{str(error).partition('; ')[0]}; {_install(cuda[0])}") from error
    supported = driver_version(driver)
    for name, needs in (("torch", cuda), ("NVRTC", compiler)):
        if supported[0] < needs[0]:  # within a major version newer code runs on older drivers
            raise BackendError(
                f"the driver supports CUDA {dotted(supported)}, but {name} needs CUDA {dotted(needs)}; {OLD_DRIVER}, "
                f"{ANYWAY}"
            )
    devices = visible_devices()
    if own_default_stream():
        raise BackendError(f"{PER_THREAD} is set: kernels would run beside torch's work, not after it; unset it")
    try:
        nvrtc.architecture_for(devices[0][1])
    except BackendError as error:
        raise BackendError(f"{devices[0][0]}: {error}") from error
    names = [f"{name} (sm_{major}{minor})" for name, (major, minor) in devices]
    versions = f"driver CUDA {dotted(supported)}, NVRTC {dotted(compiler)}"
    return f"{', '.join(names)}; {versions}{cache_words()}"


def _install(major: int) -> str:
    """Return how to install bindings and compiler with torch's CUDA version; other versions do not find each other."""
    extra = f"cuda{major}"
    if extra not in EXTRAS:
        return f"install the cuda-bindings and the NVRTC of CUDA {major}, {ANYWAY}"
    return f"{install(extra)} (the extra {extra}; torch's CUDA wheels bring the compiler), {ANYWAY}"


def cache_words() -> str:
    """Return a note about a cache that cannot be written, "" if it can."""
    cache = nvrtc.cache_folder()
    if nvrtc.is_writable(cache):
        return ""
    where = "there is no home folder (set GS2D_CACHE)" if cache is None else f"{cache} cannot be written"
    return f"; {where}: kernels are compiled at every start"


def visible_devices() -> list[tuple[str, tuple[int, int]]]:
    """Return name and compute capability of the devices visible to torch, the current one first.

    Raises BackendError with torch's warning if there is none.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        usable = torch.cuda.is_available()
    if not usable:
        warning = f" ({str(caught[0].message).splitlines()[0]})" if caught else ""
        raise BackendError(f"torch sees no CUDA device{warning}; check `nvidia-smi` and CUDA_VISIBLE_DEVICES, {ANYWAY}")
    first = torch.cuda.current_device()
    order = sorted(range(torch.cuda.device_count()), key=lambda index: index != first)
    return [(torch.cuda.get_device_name(i), torch.cuda.get_device_capability(i)) for i in order]


def version_of(text: str) -> tuple[int, int]:
    """Parse a version: "6.2.41133" -> (6, 2)."""
    major, _, rest = text.partition(".")
    return int(major), int(rest.partition(".")[0] or 0)


def dotted(version: tuple[int, int]) -> str:
    """Format a version: (6, 2) -> "6.2"."""
    return f"{version[0]}.{version[1]}"
