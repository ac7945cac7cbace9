"""Find, load and describe the native CPU library.

There is one library per instruction set (CMakeLists.txt); ``load()`` picks the best one that this processor can run.
The environment variable ``GS2D_CPU_VARIANT`` (``v4``, ``v3`` or ``portable``) overrides the choice.
"""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.errors import BackendError, ShapeError
from gs2d.kernels.buffer_pool import BufferPool
from gs2d.kernels.c_structures import arguments_of, signature_of

ABI_VERSION = 10  # version of the function signatures; a library with another version is refused
RESULTS_VERSION = 9  # version of the computed bits; a run resumes only with the version it started with
VARIANTS = {"v4": 4, "v3": 3, "portable": 0}  # name -> required processor level, best first
LANGUAGE = {"v4": "AVX-512 (x86-64-v4)", "v3": "AVX2 (x86-64-v3)", "portable": "portable", "f64": "portable, float64"}
FOLDER = Path(__file__).parent / "lib"
REMEDY = (
    "install a C++20 compiler (g++ >= 12 or clang++ >= 14) and run `pip install --force-reinstall --no-deps .` "
    "(in a source checkout: `make kernels`); --backend reference trains without it, slowly and without a mesh"
)


class Library:
    """One loaded native library."""

    def __init__(self, path: Path, variant: str) -> None:
        try:
            self._dll = ctypes.CDLL(str(path))
            version = int(self._dll.gs2d_abi_version())
        except (OSError, AttributeError) as error:
            raise BackendError(f"the CPU kernels {path.name} cannot be loaded ({error}); {REMEDY}") from error
        if version != ABI_VERSION:
            raise BackendError(f"the CPU kernels {path.name} have version {version}, expected {ABI_VERSION}; {REMEDY}")
        self.path = path
        self.variant = variant  # "v4", "v3", "portable", or "f64" (all arithmetic in float64; tests only)
        self.pool = BufferPool()  # allocates large results
        self._functions: dict[str, Any] = {}
        self.lanes = int(self._dll.gs2d_lanes())  # pixels per vector
        # Of the arrays that its functions take.
        self.dtype = torch.float64 if int(self._dll.gs2d_real_bytes()) == 8 else torch.float32

    def call(self, name: str, /, *arguments: Any, **fields: Any) -> Any:
        """Call the exported function ``name`` with the signature in its source. The GIL is released while it runs.

        Tensors, arrays and structures are passed by address, None as null. With ``fields`` the argument is the
        structure of these fields.
        """
        function = self._functions.get(name)
        if function is None:
            try:
                function = self._dll[name]
            except AttributeError as error:
                raise BackendError(f"the CPU kernels {self.path.name} are older than gs2d; {REMEDY}") from error
            real = ctypes.c_double if self.dtype == torch.float64 else ctypes.c_float
            function.restype, function.argtypes = signature_of(name, real)
            self._functions[name] = function
        if fields:
            arguments = (arguments_of(name, **fields),)
        return function(*map(_passed, arguments))

    def arrays(self, **tensors: torch.Tensor | None) -> list[Any]:
        """Return the tensors, detached and contiguous, in the order of the arguments; None stays None.

        Raises ShapeError if a tensor is not on the CPU or has another dtype than the library.
        """
        for name, tensor in tensors.items():
            if tensor is not None and (not tensor.is_cpu or tensor.dtype != self.dtype):
                raise ShapeError(
                    f"{name} must be {self.dtype} on the cpu for the native kernels, got {tensor.dtype} on "
                    f"{tensor.device}; convert it, or use the reference backend"
                )
        return [None if tensor is None else tensor.detach().contiguous() for tensor in tensors.values()]

    def use_threads(self, n: int) -> None:
        """Use ``n`` threads in the following calls. Results do not depend on it."""
        self._dll.gs2d_set_threads(int(n))

    @property
    def threads(self) -> int:
        """Number of threads the next call will use."""
        return int(self._dll.gs2d_get_threads())

    @property
    def instruction_set(self) -> str:
        """Name of the instruction set, for display."""
        return LANGUAGE[self.variant]


def _passed(value: Any) -> Any:
    """Return an argument in the form that ctypes takes."""
    if isinstance(value, torch.Tensor):
        return value.data_ptr()
    if isinstance(value, np.ndarray):
        return value.ctypes.data
    return ctypes.byref(value) if isinstance(value, ctypes.Structure) else value


def _path(variant: str) -> Path:
    suffix = "dylib" if sys.platform == "darwin" else "so"
    return FOLDER / f"libgs2d_cpu_{variant}.{suffix}"


def available_variants() -> tuple[str, ...]:
    """Names of the built variants that this processor can run, best first; empty without the native library."""
    if not _path("portable").exists():
        return ()
    level = int(ctypes.CDLL(str(_path("portable"))).gs2d_cpu_level())
    return tuple(name for name, needs in VARIANTS.items() if level >= needs and _path(name).exists())


@cache
def _load(variant: str) -> Library:
    return Library(_path(variant), variant)


def load(variant: str | None = None) -> Library:
    """Return the native library: the named variant, or the best one for this machine.

    Variants are those of ``available_variants()`` and ``"f64"``. Without one, ``GS2D_CPU_VARIANT`` from the environment
    decides, and without that the processor. Raises BackendError if the library was not built, or the variant cannot run
    here.
    """
    return _choose(FOLDER, variant or os.environ.get("GS2D_CPU_VARIANT"))


@cache  # an iteration calls it three times, and checking the files takes 0.2 ms
def _choose(folder: Path, variant: str | None) -> Library:
    """Return the library of a variant in a folder; errors are not cached."""
    choices = available_variants()
    if not choices:
        raise BackendError(f"expected the native CPU library in the package's kernels/lib, found none; {REMEDY}")
    if variant is None:
        return _load(choices[0])
    if variant in choices or (variant == "f64" and _path("f64").exists()):
        return _load(variant)
    raise BackendError(f"CPU variant must be one of {', '.join(choices)}, got {variant!r}; unset GS2D_CPU_VARIANT")


def ready_library() -> Library:
    """Return :func:`load` set to torch's number of threads. Call it at the start of every native operation."""
    library = load()
    library.use_threads(torch.get_num_threads())
    return library


def optional_library() -> Library | None:
    """Return :func:`ready_library`, or None if it was not built: for operations that also exist in numpy or torch.

    A library that was built before a function was added is an error when that function is called.
    """
    try:
        return ready_library()
    except BackendError:
        return None


def library_for(tensor: torch.Tensor) -> Library | None:
    """Return :func:`optional_library` for a float32 tensor on the CPU; None for other tensors."""
    return optional_library() if tensor.is_cpu and tensor.dtype == torch.float32 else None
