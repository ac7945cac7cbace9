"""Launch the CUDA kernels on a GPU: torch owns memory, streams and contexts, the driver loads and launches kernels.

A kernel runs on torch's current stream of its device, in the primary context, so launches are ordered with torch's own
operations: under ``torch.cuda.stream``, on several devices, in the threads of the backward pass and, after a kernel's
first launch, in a captured graph. Nothing here waits for the device.
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
from gs2d.kernels.cuda.graph import Graph, Work

ALLOCATOR_VARIABLES = ("PYTORCH_CUDA_ALLOC_CONF", "PYTORCH_ALLOC_CONF")
STEP_VARIABLE, GRAPH, LAUNCHES = "GS2D_CUDA_STEP", "graph", "launches"
GRAPHS_FROM = 3  # repetitions from which a graph pays off
MAX_GRAPHS = 64
MAX_STREAMS = 64  # cached stream objects
MAX_BLOCKS = (1 << 31) - 1


class Launcher(Protocol):
    """Runs kernels; the tensors behind the structure's pointers must outlive the call.

    A launch of 0 blocks does nothing.
    """

    def launch(self, name: str, blocks: int, threads: int, arguments: ctypes.Structure) -> None:
        """Queue the kernel ``name`` on the current stream."""

    def run(self, works: Sequence[Work]) -> None:
        """Queue kernels in order; a launcher may run repeated ones as a graph."""
        for work in works:
            self.launch(work.name, work.blocks, work.threads, work.arguments)


def _stream_of(device: torch.device) -> int:
    return int(torch.cuda.current_stream(device).cuda_stream)


def _architecture_of(device: torch.device) -> str:
    return nvrtc.architecture_for(torch.cuda.get_device_capability(device))


class GpuLauncher:
    """Launches kernels on one device; a source file is compiled and loaded at the first launch of its kernels.

    The device has an index, and the driver is the module ``cuda.bindings.driver``. ``stream_of`` and
    ``architecture_of`` return the current stream's handle and the architecture (``"sm_90"``) of a device, ``code_of``
    the machine code of a source file for an architecture; ``source_of`` are the source files by kernel. Raises
    BackendError if the driver or the device's context is missing, or the default streams of driver and torch differ.
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
            raise BackendError(f"{PER_THREAD} is set: kernels would not be ordered with torch's work; unset it")
        self.device = device
        self._driver = load_driver() if driver is None else driver
        self._stream_of, self._code_of = stream_of, code_of
        self.architecture = architecture_of(device)
        call(self._driver, "cuInit", 0)
        self._handle = call(self._driver, "cuDeviceGet", device.index or 0)
        self._context = call(self._driver, "cuDevicePrimaryCtxRetain", self._handle)  # torch's context; never released
        self._context_number = int(self._context)
        self._streams: dict[int, Any] = {}
        self._source_of = nvrtc.kernel_sources() if source_of is None else source_of
        self._libraries: dict[str, tuple[Any, bytes]] = {}  # by source; the code must outlive its library
        self._functions: dict[str, Any] = {}  # by kernel
        self._lock = threading.Lock()  # the backward pass runs in another thread
        self._replays = True
        self._graphs: dict[tuple[str, ...], Graph | int] = {}  # by kernel names; an int counts repetitions

    def launch(self, name: str, blocks: int, threads: int, arguments: ctypes.Structure) -> None:
        """Start a kernel on the current stream without waiting.

        Raises BackendError if there are too many blocks, the kernel does not compile or load, or the driver refuses the
        launch, also because an earlier kernel failed.
        """
        if blocks > 0:
            with self._in_context():
                self._start([Work(name, blocks, threads, arguments)])

    def run(self, works: Sequence[Work]) -> None:
        """Start kernels in order on the current stream without waiting.

        From the third repetition on they run as a graph, if it can be made, which cuts the host's cost and the gaps
        between kernels. Raises BackendError like :meth:`launch`.
        """
        with self._in_context():
            graph = self._graph_of(works) if self._replays and steps() == GRAPH else None
            if graph is None:
                self._start(works)
                return
            status = graph.launch(self._stream(self._stream_of(self.device)))
            if status != self._driver.CUresult.CUDA_SUCCESS:
                raise failure(f"the launch of {len(works)} kernels from {works[0].name} on", status)

    def _start(self, works: Sequence[Work]) -> None:
        """Launch in the current context; the driver copies the arguments."""
        driver, stream = self._driver, self._stream(self._stream_of(self.device))
        for work in works:
            name, blocks, threads = work.name, work.blocks, work.threads
            if blocks > MAX_BLOCKS:
                raise BackendError(
                    f"{name} needs {blocks} blocks, expected at most 2^31 - 1; use fewer splats or pixels"
                )
            function = self._functions.get(name) or self._load(name)
            status = driver.cuLaunchKernel(function, blocks, 1, 1, threads, 1, 1, 0, stream, work.parameters, 0)[0]
            if status != driver.CUresult.CUDA_SUCCESS:
                raise failure(f"the launch of {name} ({blocks} blocks of {threads})", status)

    def _graph_of(self, works: Sequence[Work]) -> Graph | None:
        """Return the updated graph of these launches; None if they were not repeated enough or graphs fail."""
        names = tuple([work.name for work in works])
        graph = self._graphs.get(names, 0)
        if isinstance(graph, int) and graph + 1 < GRAPHS_FROM:
            self._graphs[names] = graph + 1
            return None
        try:
            if isinstance(graph, int):
                if len(self._graphs) > MAX_GRAPHS:
                    self._graphs.clear()
                kernels = [self._functions.get(name) or self._load(name) for name in names]
                graph = self._graphs[names] = Graph(self._driver, kernels, works)
            else:
                graph.change(works)
        except BackendError:  # too little memory: launch one by one
            self._replays = False
            self._graphs.clear()
            return None
        return graph

    @contextmanager
    def _in_context(self) -> Iterator[None]:
        """Make the device's context current; a thread that only used torch's cached memory may have none."""
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
        """Return the driver's object for a stream, cached."""
        if handle not in self._streams:
            if len(self._streams) >= MAX_STREAMS:
                self._streams.clear()
            self._streams[handle] = self._driver.CUstream(handle)
        return self._streams[handle]

    def _load(self, name: str) -> Any:
        """Return the handle of a kernel; loads its file if necessary."""
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
            # A kernel handle can be launched like a function handle, in any context.
            self._functions[name] = self._driver.CUfunction(int(kernel))
            return self._functions[name]


def steps() -> str:
    """Return ``GS2D_CUDA_STEP``: "graph" (default), or "launches" to start the kernels of an iteration one by one."""
    chosen = os.environ.get(STEP_VARIABLE) or GRAPH
    if chosen not in (GRAPH, LAUNCHES):
        raise BackendError(f"{STEP_VARIABLE} must be {GRAPH} or {LAUNCHES}, got {chosen!r}; unset it")
    return chosen


def grow_in_place() -> bool:
    """Enable torch's expandable memory segments, unless the user configured its allocator; return whether they were.

    Each densification creates 18 tensors of new sizes, about 145 times a run. Without expandable segments the freed
    blocks are too small, and the device waits for new memory each time.
    """
    if torch.version.cuda is None or any(os.environ.get(name) for name in ALLOCATOR_VARIABLES):
        return False
    try:  # the newer name first, since the older one warns
        setting = getattr(torch._C, "_accelerator_setAllocatorSettings", None)
        (setting or torch.cuda.memory._set_allocator_settings)("expandable_segments:True")
    except (AttributeError, RuntimeError):  # not supported by this version or platform
        return False
    return True


@cache
def _of_device(index: int) -> GpuLauncher:
    return GpuLauncher(torch.device("cuda", index))


def launcher_for(device: torch.device) -> Launcher:
    """Return the launcher of a device; one per device and process.

    Raises ShapeError if the device is not a CUDA device, and BackendError if it cannot run the kernels.
    """
    if device.type != "cuda":
        raise ShapeError(
            f"tensors must be on a CUDA device for the cuda backend, got {device}; "
            "move them with .to('cuda'), or use --backend cpu"
        )
    return _of_device(torch.cuda.current_device() if device.index is None else device.index)
