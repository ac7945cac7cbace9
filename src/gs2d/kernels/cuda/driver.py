"""The CUDA driver through ``cuda.bindings``, imported at first use, and error messages with remedies."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gs2d.errors import BackendError

BINDINGS_REMEDY = "pip install cuda-bindings (torch's CUDA wheels for Linux bring it), or use --backend cpu"
DRIVER_REMEDY = "install NVIDIA's driver (`nvidia-smi` must list the GPU), or use --backend cpu"
OLD_DRIVER = "update NVIDIA's driver, or install the torch build and NVRTC of the driver's CUDA version"
RESTART = "results of this process cannot be trusted: start it again; if it happens again, please report it"
REMEDIES = {
    "CUDA_ERROR_OUT_OF_MEMORY": "use fewer splats or --downscale, or free the GPU's memory",
    "CUDA_ERROR_NO_DEVICE": "check `nvidia-smi` and CUDA_VISIBLE_DEVICES, or use --backend cpu",
    "CUDA_ERROR_NO_BINARY_FOR_GPU": OLD_DRIVER,
    "CUDA_ERROR_INVALID_IMAGE": OLD_DRIVER,
    "CUDA_ERROR_UNSUPPORTED_PTX_VERSION": OLD_DRIVER,
    "CUDA_ERROR_SYSTEM_DRIVER_MISMATCH": "driver and kernel module differ: reboot",
    "CUDA_ERROR_SYSTEM_NOT_READY": "the GPU's fabric or service is not up: check `nvidia-smi`",
    "CUDA_ERROR_NOT_FOUND": "kernels and Python package have different versions: install gs2d again",
    "CUDA_ERROR_INVALID_HANDLE": "the GPU was reset under this process: start it again",
    "CUDA_ERROR_CONTEXT_IS_DESTROYED": "the GPU was reset under this process: start it again",
    "CUDA_ERROR_LAUNCH_OUT_OF_RESOURCES": "a kernel is too large for this GPU; please report it",
    "CUDA_ERROR_ILLEGAL_ADDRESS": RESTART,
    "CUDA_ERROR_MISALIGNED_ADDRESS": RESTART,
    "CUDA_ERROR_LAUNCH_FAILED": RESTART,
    "CUDA_ERROR_LAUNCH_TIMEOUT": "the display's watchdog stopped a kernel: use a GPU without a display, or --downscale",
    "CUDA_ERROR_ECC_UNCORRECTABLE": "the GPU's memory is failing: reset it, or use another one",
}

# If set, stream 0 is a stream per thread for cuda.bindings, but one stream of all threads for torch.
PER_THREAD = "CUDA_PYTHON_CUDA_PER_THREAD_DEFAULT_STREAM"


def own_default_stream() -> bool:
    """Whether kernels on the default stream would not be ordered with torch's work on it."""
    return os.environ.get(PER_THREAD, "0") not in ("", "0")


@contextmanager
def fault_of(what: str) -> Iterator[None]:
    """Convert a CUDA error that torch reports while waiting into a BackendError with a remedy."""
    try:
        yield
    except RuntimeError as error:  # torch.AcceleratorError is one, since torch 2.8
        words = one_line(error)
        if not words.startswith("CUDA error"):
            raise
        remedy = REMEDIES["CUDA_ERROR_OUT_OF_MEMORY"] if "out of memory" in words else RESTART
        raise BackendError(f"the GPU failed in {what} or before ({words}); {remedy}") from error


def load_driver() -> Any:
    """Return the module ``cuda.bindings.driver``; BackendError if it is not installed."""
    try:
        from cuda.bindings import driver
    except (ImportError, RuntimeError, OSError) as error:
        raise BackendError(
            f"the Python package cuda.bindings is missing ({one_line(error)}); {BINDINGS_REMEDY}"
        ) from error
    return driver


def driver_version(driver: Any) -> tuple[int, int]:
    """Return the newest CUDA version that the driver supports, (major, minor); BackendError without a driver."""
    try:
        number = int(call(driver, "cuDriverGetVersion"))
    except (ImportError, RuntimeError, OSError) as error:  # the bindings load the library at the first call
        raise BackendError(f"no NVIDIA driver is installed ({one_line(error)}); {DRIVER_REMEDY}") from error
    return number // 1000, number % 1000 // 10


def call(driver: Any, name: str, *arguments: Any) -> Any:
    """Call a function of the driver and return its value, or None; BackendError with a remedy if it fails."""
    status, *values = getattr(driver, name)(*arguments)
    if status != driver.CUresult.CUDA_SUCCESS:
        raise failure(name, status)
    return values[0] if values else None


def failure(what: str, status: Any) -> BackendError:
    """Return the error for a status other than success."""
    name = str(getattr(status, "name", status))
    remedy = REMEDIES.get(name, "check `nvidia-smi` and the driver, or use --backend cpu")
    return BackendError(f"the CUDA driver failed in {what} ({name}); {remedy}")


def one_line(error: BaseException) -> str:
    """Return the first line of an error message."""
    words = str(error).strip().splitlines()
    return words[0] if words else type(error).__name__
