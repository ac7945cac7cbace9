"""AMD's run-time library (HIP) in the place of the CUDA driver: what the launcher calls, by the names it calls it.

torch built for ROCm calls AMD's GPUs "cuda" and brings ``libamdhip64``; it is called with ctypes. A device's context is
here the device itself, plus one, since 0 is none. Nothing of this has run on an AMD GPU (docs/guides/gpu.md).
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import threading
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch

from gs2d.errors import BackendError

__all__ = ["HipDriver", "find_library", "load_hip"]

RUNTIME = "libamdhip64"
REMEDY = "install torch's build for ROCm, which brings it, or use --backend cpu"


class Status(NamedTuple):
    """What a function of HIP returned."""

    number: int
    name: str


class _Statuses:
    CUDA_SUCCESS = Status(0, "hipSuccess")


class _Attributes:
    CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES = 8


class NodeParameters(ctypes.Structure):
    """``hipKernelNodeParams``, by the names that CUDA's structure has."""

    _fields_ = (
        *((f"blockDim{axis}", ctypes.c_uint32) for axis in "XYZ"),
        ("extra", ctypes.c_void_p),
        ("kern", ctypes.c_void_p),
        *((f"gridDim{axis}", ctypes.c_uint32) for axis in "XYZ"),
        ("kernelParams", ctypes.c_void_p),
        ("sharedMemBytes", ctypes.c_uint32),
    )


_POINTER, _NUMBER = ctypes.c_void_p, ctypes.c_uint32
_OUT = ctypes.POINTER(ctypes.c_void_p)
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "hipInit": (_NUMBER,),
    "hipRuntimeGetVersion": (ctypes.POINTER(ctypes.c_int),),
    "hipGetDevice": (ctypes.POINTER(ctypes.c_int),),
    "hipSetDevice": (ctypes.c_int,),
    "hipModuleLoadData": (_OUT, ctypes.c_char_p),
    "hipModuleGetFunction": (_OUT, _POINTER, ctypes.c_char_p),
    "hipModuleLaunchKernel": (_POINTER, *(7 * (_NUMBER,)), _POINTER, _POINTER, _POINTER),
    "hipGraphCreate": (_OUT, _NUMBER),
    "hipGraphAddKernelNode": (_OUT, _POINTER, _OUT, ctypes.c_size_t, ctypes.POINTER(NodeParameters)),
    "hipGraphInstantiate": (_OUT, _POINTER, _POINTER, _POINTER, ctypes.c_size_t),
    "hipGraphExecKernelNodeSetParams": (_POINTER, _POINTER, ctypes.POINTER(NodeParameters)),
    "hipGraphLaunch": (_POINTER, _POINTER),
}


class HipDriver:
    """The functions of ``cuda.bindings.driver`` that :mod:`gs2d.kernels.cuda.launch` calls, done by HIP.

    Parameters
    ----------
    library : ctypes.CDLL
        ``libamdhip64``.

    Raises
    ------
    BackendError
        It lacks a function.
    """

    CUresult, CUfunction_attribute = _Statuses, _Attributes
    CUstream = CUfunction = CUkernel = staticmethod(int)
    CUDA_KERNEL_NODE_PARAMS = NodeParameters
    OLDEST_GRAPHS = (6, 0)  # before, nodes took no kernel of a module
    MAX_THREADS = (1 << 32) - 1  # of all blocks of a launch together
    CALLED = {  # noqa: RUF012
        "cuInit": "hipInit",
        "cuDriverGetVersion": "hipRuntimeGetVersion",
        "cuDevicePrimaryCtxRetain": "hipSetDevice",
        "cuCtxGetCurrent": "hipGetDevice",
        "cuCtxPushCurrent": "hipSetDevice",
        "cuCtxPopCurrent": "hipSetDevice",
        "cuLibraryLoadData": "hipModuleLoadData",
        "cuLibraryGetKernel": "hipModuleGetFunction",
        "cuGraphCreate": "hipGraphCreate",
        "cuGraphAddKernelNode": "hipGraphAddKernelNode",
        "cuGraphInstantiate": "hipGraphInstantiate",
        "cuGraphExecKernelNodeSetParams": "hipGraphExecKernelNodeSetParams",
    }

    def __init__(self, library: ctypes.CDLL) -> None:
        self._functions: dict[str, Any] = {}
        for name, kinds in _SIGNATURES.items():
            try:
                function = getattr(library, name)
            except AttributeError as error:
                raise BackendError(f"{RUNTIME} has no function {name} ({error}); {REMEDY}") from error
            function.restype, function.argtypes = ctypes.c_int, kinds
            self._functions[name] = function
        self._name_of = library.hipGetErrorName
        self._name_of.restype, self._name_of.argtypes = ctypes.c_char_p, (ctypes.c_int,)
        self._before = threading.local()  # devices that were current, of each thread

    def _call(self, name: str, *arguments: Any) -> Status:
        number = int(self._functions[name](*arguments))
        if number == 0:
            return _Statuses.CUDA_SUCCESS
        return Status(number, (self._name_of(number) or b"hipErrorUnknown").decode())

    def _made(self, name: str, *arguments: Any) -> tuple[Status, int]:
        """Return the status, and what the function wrote to where its first argument points."""
        out = ctypes.c_void_p()
        return self._call(name, ctypes.byref(out), *arguments), out.value or 0

    def _asked(self, name: str) -> tuple[Status, int]:
        out = ctypes.c_int(-1)
        return self._call(name, ctypes.byref(out)), out.value

    # -- what the launcher calls ---------------------------------------------------------------------------------------
    def cuInit(self, flags: int) -> tuple[Status]:
        """Make HIP ready."""
        return (self._call("hipInit", flags),)

    def cuDriverGetVersion(self) -> tuple[Status, int]:
        """Return HIP's version as CUDA writes its own: 6.2 is 6020."""
        status, number = self._asked("hipRuntimeGetVersion")  # 60241134: 6.2
        return status, 1000 * (number // 10_000_000) + 10 * (number // 100_000 % 100)

    def cuDeviceGet(self, ordinal: int) -> tuple[Status, int]:
        """Devices are their numbers."""
        return _Statuses.CUDA_SUCCESS, ordinal

    def cuDevicePrimaryCtxRetain(self, device: int) -> tuple[Status, int]:
        """Return what stands for a device's context; an error where there is no such device."""
        status, before = self._asked("hipGetDevice")
        if status.number == 0:
            status = self._call("hipSetDevice", device)
        if status.number == 0:
            status = self._call("hipSetDevice", before)
        return status, device + 1

    def cuCtxGetCurrent(self) -> tuple[Status, int]:
        """Return the calling thread's device, plus one."""
        status, device = self._asked("hipGetDevice")
        return status, device + 1

    def cuCtxPushCurrent(self, context: int) -> tuple[Status]:
        """Make a device the calling thread's."""
        status, device = self._asked("hipGetDevice")
        if status.number == 0:
            status = self._call("hipSetDevice", context - 1)
        if status.number == 0:
            self._before.devices = [*getattr(self._before, "devices", []), device]
        return (status,)

    def cuCtxPopCurrent(self) -> tuple[Status, int]:
        """Go back to the device of before."""
        *self._before.devices, device = self._before.devices
        return self._call("hipSetDevice", device), device + 1

    def cuLibraryLoadData(self, code: bytes, *nothing: Any) -> tuple[Status, int]:
        """Load a code object for the current device."""
        return self._made("hipModuleLoadData", code)

    def cuLibraryGetKernel(self, library: int, name: bytes) -> tuple[Status, int]:
        """Return the handle of a kernel."""
        return self._made("hipModuleGetFunction", library, name)

    def cuKernelSetAttribute(self, *_: Any) -> tuple[Status]:
        """Nothing has to be asked for: a block has 64 KiB."""
        return (_Statuses.CUDA_SUCCESS,)

    def cuLaunchKernel(self, *given: int) -> tuple[Status]:
        """Start a kernel: its blocks and threads by axis, shared memory, stream, parameters, and nothing."""
        return (self._call("hipModuleLaunchKernel", *given),)

    def cuGraphCreate(self, flags: int) -> tuple[Status, int]:
        """Make a graph without nodes."""
        return self._made("hipGraphCreate", flags)

    def cuGraphAddKernelNode(
        self, graph: int, after: list[int], count: int, parameters: NodeParameters
    ) -> tuple[Status, int]:
        """Add a kernel to a graph, behind other nodes."""
        nodes = (ctypes.c_void_p * count)(*after) if count else None
        return self._made("hipGraphAddKernelNode", graph, nodes, count, ctypes.byref(parameters))

    def cuGraphInstantiate(self, graph: int, flags: int) -> tuple[Status, int]:
        """Make a graph ready to be launched."""
        return self._made("hipGraphInstantiate", graph, None, None, 0)

    def cuGraphExecKernelNodeSetParams(self, executable: int, node: int, parameters: NodeParameters) -> tuple[Status]:
        """Change the arguments of a kernel in a graph that is ready."""
        return (self._call("hipGraphExecKernelNodeSetParams", executable, node, ctypes.byref(parameters)),)

    def cuGraphLaunch(self, executable: int, stream: int) -> tuple[Status]:
        """Start a graph on a stream."""
        return (self._call("hipGraphLaunch", executable, stream),)


def find_library(stem: str, function: str = "") -> ctypes.CDLL:
    """Return a library of ROCm: the one that this process has loaded already, torch's, or that of the system.

    Parameters
    ----------
    stem : str
        ``"libamdhip64"``.
    function : str
        That it must have.

    Raises
    ------
    OSError
        It is nowhere.
    """
    named = ctypes.util.find_library(stem.removeprefix("lib"))
    said = f"{stem}.so: not found"
    for path in [*_loaded(stem), *_beside(stem), *([named] if named else [])]:
        try:
            library = ctypes.CDLL(str(path))
        except OSError as error:
            said = str(error)
            continue
        if not function or hasattr(library, function):
            return library
        said = f"{path} has no {function}"
    raise OSError(said)


def _loaded(stem: str) -> list[Path]:
    """Return what this process has mapped: two copies of the run-time library would each have devices of their own."""
    try:
        lines = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []
    paths = dict.fromkeys(line.split(maxsplit=5)[5] for line in lines if line.count(" /") and f"/{stem}.so" in line)
    return [Path(path) for path in paths]


def _beside(stem: str) -> list[Path]:
    """Return files of this name where torch's wheels and ROCm have theirs, the newest version first."""
    folders = [Path(torch.__file__).parent / "lib", Path(os.environ.get("ROCM_PATH") or "/opt/rocm") / "lib"]
    return [path for folder in folders for path in sorted(folder.glob(f"{stem}.so*"), reverse=True)]


@cache
def load_hip() -> HipDriver:
    """Return the run-time library, ready to call.

    Raises
    ------
    BackendError
        It is not here.
    """
    try:
        return HipDriver(find_library(RUNTIME))
    except OSError as error:
        raise BackendError(f"AMD's run-time library {RUNTIME} is not here ({error}); {REMEDY}") from error
