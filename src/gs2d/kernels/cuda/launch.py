"""Launch the CUDA kernels on a GPU: torch owns memory, streams and contexts, the driver only loads and launches.

A kernel runs on the stream that is current in torch for its device, in torch's (the primary) context of that device,
so launches fit in between torch's own operations, under ``torch.cuda.stream``, on several devices, in the threads of
the backward pass and, once a kernel has been launched before, in a captured graph. Nothing here waits for the device.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, Protocol

import torch

from gs2d.errors import BackendError, ShapeError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda.driver import PER_THREAD, call, failure, load_driver, own_default_stream
from gs2d.kernels.cuda.graph import Graph, Work, can_replay

__all__ = ["GpuLauncher", "Launcher", "OneByOne", "Work", "grow_in_place", "launcher_for", "steps"]

ALLOCATOR_VARIABLES = ("PYTORCH_CUDA_ALLOC_CONF", "PYTORCH_ALLOC_CONF")
STEP_VARIABLE, GRAPH, LAUNCHES = "GS2D_CUDA_STEP", "graph", "launches"
STATIC_SHARED_BYTES = 48 << 10  # what a block may have without asking
GRAPHS_FROM = 3  # times that the same launches come, from which they are worth a graph
MAX_GRAPHS = 64
MAX_STREAMS = 64  # that are known by their objects
MAX_BLOCKS = (1 << 31) - 1


class Launcher(Protocol):
    """Runs one kernel; the structure's pointers are those of tensors that outlive the call.

    ``shared_bytes`` is dynamic shared memory. A launch of no blocks does nothing.
    """

    def launch(self, name: str, blocks: int, threads: int, arguments: ctypes.Structure, shared_bytes: int = 0) -> None:
        """Queue the kernel ``name`` on the current stream."""

    def run(self, works: Sequence[Work]) -> None:
        """Queue kernels one after another; the same ones may be started as a graph."""


class OneByOne:
    """Of a launcher that has nothing better for many launches."""

    def run(self, works: Sequence[Work]) -> None:
        """Launch each."""
        for work in works:
            self.launch(work.name, work.blocks, work.threads, work.arguments)  # type: ignore[attr-defined]


def _stream_of(device: torch.device) -> int:
    return int(torch.cuda.current_stream(device).cuda_stream)


def _architecture_of(device: torch.device) -> str:
    return nvrtc.architecture_for(torch.cuda.get_device_capability(device))


class GpuLauncher:
    """Launches kernels on one device; a source file is compiled and loaded when one of its kernels is first wanted.

    Parameters
    ----------
    device : torch.device
        With an index.
    driver : module, optional
        ``cuda.bindings.driver``, or the tests' own.
    stream_of, architecture_of : callable
        The current stream's handle, and the architecture (``"sm_90"``), of a device.
    code_of : callable
        Machine code of a source file for an architecture.
    source_of : mapping of str to str, optional
        The file of each kernel; by default the package's.

    Raises
    ------
    BackendError
        The driver or its context of the device is not there, or streams mean something else to it than to torch.
    """

    def __init__(
        self,
        device: torch.device,
        *,
        driver: Any = None,
        stream_of: Callable[[torch.device], int] = _stream_of,
        architecture_of: Callable[[torch.device], str] = _architecture_of,
        code_of: Callable[[str, str], bytes] = lambda name, arch: nvrtc.cubin(name, arch).code,
        source_of: Mapping[str, str] | None = None,
    ) -> None:
        if own_default_stream():
            raise BackendError(f"{PER_THREAD} is set: kernels would run beside torch's work, not after it; unset it")
        self.device = device
        self._driver = load_driver() if driver is None else driver
        self._stream_of, self._code_of = stream_of, code_of
        self.architecture = architecture_of(device)
        call(self._driver, "cuInit", 0)
        self._handle = call(self._driver, "cuDeviceGet", device.index or 0)
        self._context = call(self._driver, "cuDevicePrimaryCtxRetain", self._handle)  # torch's; for good
        self._context_number = int(self._context)
        self._streams: dict[int, Any] = {}
        self._source_of = nvrtc.kernel_sources() if source_of is None else source_of
        self._libraries: dict[str, tuple[Any, bytes]] = {}  # by source; the code stays alive beside its library
        self._functions: dict[str, Any] = {}  # by kernel
        self._allowed: dict[str, int] = {}  # dynamic shared memory asked for so far, by kernel
        self._lock = threading.Lock()  # the backward pass runs in a thread of its own
        self._replays = can_replay(self._driver)
        self._graphs: dict[tuple[str, ...], Graph | int] = {}  # by their kernels; how often these came before

    def launch(self, name: str, blocks: int, threads: int, arguments: ctypes.Structure, shared_bytes: int = 0) -> None:
        """Start a kernel on the current stream, and return at once.

        Raises
        ------
        BackendError
            Too many blocks, a kernel that does not compile or load, or a launch that the driver refuses; also an error
            that an earlier kernel left behind.
        """
        if blocks == 0:
            return
        if blocks > MAX_BLOCKS:
            raise BackendError(f"{name} needs {blocks} blocks, expected at most 2^31 - 1; use fewer splats or pixels")
        driver = self._driver
        given = (name, blocks, threads, ctypes.c_void_p(ctypes.addressof(arguments)), shared_bytes)
        if int(call(driver, "cuCtxGetCurrent")) == self._context_number:  # nearly always
            status = self._start(*given)
        else:
            with self._in_context():
                status = self._start(*given)
        if status != driver.CUresult.CUDA_SUCCESS:
            raise failure(f"the launch of {name} ({blocks} blocks of {threads})", status)

    def run(self, works: Sequence[Work]) -> None:
        """Start kernels one after another on the current stream, and return at once.

        From the third time on the same kernels are a graph, where the driver knows graphs and makes it: what the
        launches cost the host, and the pauses between kernels, are then a fraction. Else each is launched.

        Raises
        ------
        BackendError
            As of :meth:`launch`.
        """
        if int(call(self._driver, "cuCtxGetCurrent")) == self._context_number:
            self._run(works)
        else:
            with self._in_context():
                self._run(works)

    def _run(self, works: Sequence[Work]) -> None:
        driver, stream = self._driver, self._stream(self._stream_of(self.device))
        success = driver.CUresult.CUDA_SUCCESS
        graph = self._graph_of(works) if self._replays and steps() == GRAPH else None
        if graph is not None:
            status = graph.launch(stream)
            if status != success:
                raise failure(f"the launch of {len(works)} kernels from {works[0].name} on", status)
            return
        for work in works:
            function = self._functions.get(work.name) or self._load(work.name)
            status = driver.cuLaunchKernel(
                function, work.blocks, 1, 1, work.threads, 1, 1, 0, stream, work.parameters, 0
            )[0]
            if status != success:
                raise failure(f"the launch of {work.name} ({work.blocks} blocks of {work.threads})", status)

    def _graph_of(self, works: Sequence[Work]) -> Graph | None:
        """Return the graph of these launches, as they are now; None: they have not come often enough, or cannot be."""
        names = tuple([work.name for work in works])
        known = self._graphs.get(names, 0)
        if isinstance(known, int) and known + 1 < GRAPHS_FROM:
            self._graphs[names] = known + 1
            return None
        try:
            if isinstance(known, int):
                if len(self._graphs) > MAX_GRAPHS:
                    self._graphs.clear()
                kernels = [self._functions.get(name) or self._load(name) for name in names]
                known = self._graphs[names] = Graph(self._driver, kernels, works)
            else:
                known.change(works)
        except BackendError:  # an old driver, or no room: slower, no worse
            self._replays = False
            self._graphs.clear()
            return None
        return known

    def _start(self, name: str, blocks: int, threads: int, argument: ctypes.c_void_p, shared_bytes: int) -> Any:
        """Launch in the context that is current; the driver copies what the argument points to."""
        function = self._functions.get(name) or self._load(name)
        if shared_bytes > STATIC_SHARED_BYTES and shared_bytes > self._allowed.get(name, 0):
            self._allow(name, shared_bytes)
        stream, at = self._stream(self._stream_of(self.device)), ctypes.addressof(argument)
        return self._driver.cuLaunchKernel(function, blocks, 1, 1, threads, 1, 1, shared_bytes, stream, at, 0)[0]

    @contextmanager
    def _in_context(self) -> Iterator[None]:
        """Make the device's context current: a thread that has only used torch's cached memory may have none."""
        driver = self._driver
        if int(call(driver, "cuCtxGetCurrent")) == self._context_number:
            yield
            return
        call(driver, "cuCtxPushCurrent", self._context)
        try:
            yield
        finally:
            call(driver, "cuCtxPopCurrent")

    def _stream(self, handle: int) -> Any:
        """Return the driver's object for a stream; kept, as most launches are on one."""
        if handle not in self._streams:
            if len(self._streams) >= MAX_STREAMS:
                self._streams.clear()
            self._streams[handle] = self._driver.CUstream(handle)
        return self._streams[handle]

    def _load(self, name: str) -> Any:
        """Return the handle of a kernel, loading its file if need be."""
        with self._lock:
            if name in self._functions:
                return self._functions[name]
            source = self._source_of.get(name)
            if source is None:
                raise BackendError(
                    f"kernel must be one of {', '.join(self._source_of)}, got {name!r}; install gs2d again"
                )
            if source not in self._libraries:
                code = self._code_of(source, self.architecture)
                library = call(self._driver, "cuLibraryLoadData", code, [], [], 0, [], [], 0)
                self._libraries[source] = library, code
            kernel = call(self._driver, "cuLibraryGetKernel", self._libraries[source][0], name.encode())
            # A kernel's handle may be launched as a function's, in any context.
            self._functions[name] = self._driver.CUfunction(int(kernel))
            return self._functions[name]

    def _allow(self, name: str, shared_bytes: int) -> None:
        attribute = self._driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
        kernel = self._driver.CUkernel(int(self._functions[name]))
        call(self._driver, "cuKernelSetAttribute", attribute, shared_bytes, kernel, self._handle)
        self._allowed[name] = shared_bytes


def steps() -> str:
    """Return how the launches of an iteration are started: ``GS2D_CUDA_STEP``, "graph" where it is not set.

    "launches" starts each kernel by itself.

    Raises
    ------
    BackendError
        It is neither.
    """
    chosen = os.environ.get(STEP_VARIABLE) or GRAPH
    if chosen not in (GRAPH, LAUNCHES):
        raise BackendError(f"{STEP_VARIABLE} must be {GRAPH} or {LAUNCHES}, got {chosen!r}; unset it")
    return chosen


def grow_in_place() -> bool:
    """Let torch's segments of memory grow, unless the user has told its allocator something.

    Each densification makes 18 tensors of new sizes, some 145 times a run: without, each time the pieces of before are
    too small for the next ones, and the device waits while more memory is got.

    Returns
    -------
    bool
        Whether torch was told.
    """
    if torch.version.cuda is None or any(os.environ.get(name) for name in ALLOCATOR_VARIABLES):
        return False
    try:  # under its newer name first: the older one warns
        setting = getattr(torch._C, "_accelerator_setAllocatorSettings", None)
        (setting or torch.cuda.memory._set_allocator_settings)("expandable_segments:True")
    except (AttributeError, RuntimeError):  # not of this version or platform: slower, no worse
        return False
    return True


@cache
def _of_device(index: int) -> GpuLauncher:
    return GpuLauncher(torch.device("cuda", index))


def launcher_for(device: torch.device) -> Launcher:
    """Return the launcher of the device on which tensors lie; one for each device of this process.

    Raises
    ------
    ShapeError
        The device is no CUDA device.
    BackendError
        It cannot run kernels here.
    """
    if device.type != "cuda":
        raise ShapeError(
            f"tensors must be on a CUDA device for the cuda backend, got {device}; "
            "move them with .to('cuda'), or use --backend cpu"
        )
    return _of_device(torch.cuda.current_device() if device.index is None else device.index)
