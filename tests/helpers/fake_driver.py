"""A fake CUDA driver: records calls, fails on request, and can run kernels in the emulator."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import torch

from emulate import Emulator
from gs2d.kernels.cuda.launch import GpuLauncher


class Result(IntEnum):
    CUDA_SUCCESS = 0
    CUDA_ERROR_OUT_OF_MEMORY = 2
    CUDA_ERROR_INVALID_IMAGE = 200
    CUDA_ERROR_INVALID_CONTEXT = 201
    CUDA_ERROR_NO_BINARY_FOR_GPU = 209
    CUDA_ERROR_NOT_FOUND = 500
    CUDA_ERROR_NOT_SUPPORTED = 801
    CUDA_ERROR_ILLEGAL_ADDRESS = 700
    CUDA_ERROR_SOMETHING_NEW = 9999


ARGUMENT_BYTES = 1024  # larger than any argument structure


@dataclass(frozen=True)
class Launch:
    """One launch as received by the driver."""

    kernel: str
    grid: tuple[int, int, int]
    block: tuple[int, int, int]
    shared: int
    stream: int
    context: int
    argument: bytes


class NodeParameters:
    """``CUDA_KERNEL_NODE_PARAMS``."""

    kern: int
    gridDimX: int
    blockDimX: int
    kernelParams: int


@dataclass
class Node:
    """A kernel node of a graph, with a copy of its argument."""

    kernel: int
    after: list[int]
    blocks: int = 0
    threads: int = 0
    argument: ctypes.Array[ctypes.c_char] | None = None

    def take(self, parameters: NodeParameters) -> None:
        address = ctypes.cast(parameters.kernelParams, ctypes.POINTER(ctypes.c_void_p))[0]
        assert address is not None
        self.blocks, self.threads = parameters.gridDimX, parameters.blockDimX
        self.argument = ctypes.create_string_buffer(ctypes.string_at(address, ARGUMENT_BYTES), ARGUMENT_BYTES)


@dataclass
class FakeDriver:
    """The functions of ``cuda.bindings.driver`` that the launcher calls."""

    emulator: Emulator | None = None  # if set, executes the launches
    argument_bytes: int = 0  # number of argument bytes to record
    failing: dict[str, Result] = field(default_factory=dict)
    current: list[int] = field(default_factory=lambda: [0])  # context stack of the calling thread
    loaded: list[bytes] = field(default_factory=list)
    launches: list[Launch] = field(default_factory=list)
    names: list[str] = field(default_factory=list)  # index: handle - 1
    version: int = 12080
    graphs: list[list[Node]] = field(default_factory=list)  # index: handle - 1
    replays: list[int] = field(default_factory=list)  # launched graphs
    changes: int = 0  # number of node updates

    CUresult = Result
    CUstream = CUfunction = CUkernel = staticmethod(int)
    CUDA_KERNEL_NODE_PARAMS = NodeParameters

    def _done(self, name: str, *values: Any) -> tuple[Any, ...]:
        return (self.failing.get(name, Result.CUDA_SUCCESS), *values)

    def cuInit(self, flags: int) -> tuple[Any, ...]:
        return self._done("cuInit")

    def cuDriverGetVersion(self) -> tuple[Any, ...]:
        return self._done("cuDriverGetVersion", self.version)

    def cuDeviceGet(self, ordinal: int) -> tuple[Any, ...]:
        return self._done("cuDeviceGet", ordinal)

    def cuDevicePrimaryCtxRetain(self, device: int) -> tuple[Any, ...]:
        return self._done("cuDevicePrimaryCtxRetain", 1000 + device)

    def cuCtxGetCurrent(self) -> tuple[Any, ...]:
        return self._done("cuCtxGetCurrent", self.current[-1])

    def cuCtxPushCurrent(self, context: int) -> tuple[Any, ...]:
        self.current.append(context)
        return self._done("cuCtxPushCurrent")

    def cuCtxPopCurrent(self) -> tuple[Any, ...]:
        return self._done("cuCtxPopCurrent", self.current.pop())

    def cuLibraryLoadData(self, code: bytes, *nothing: Any) -> tuple[Any, ...]:
        assert nothing == ([], [], 0, [], [], 0)
        self.loaded.append(code)
        return self._done("cuLibraryLoadData", len(self.loaded))

    def cuLibraryGetKernel(self, library: int, name: bytes) -> tuple[Any, ...]:
        assert 0 < library <= len(self.loaded)
        self.names.append(name.decode())
        return self._done("cuLibraryGetKernel", len(self.names))

    def cuLaunchKernel(self, function: int, *rest: int) -> tuple[Any, ...]:
        gx, gy, gz, bx, by, bz, shared, stream, parameters, extra = rest
        assert extra == 0
        name = self.names[function - 1]
        address = ctypes.cast(parameters, ctypes.POINTER(ctypes.c_void_p))[0]
        assert address is not None
        argument = ctypes.string_at(address, self.argument_bytes)
        self.launches.append(Launch(name, (gx, gy, gz), (bx, by, bz), shared, stream, self.current[-1], argument))
        if self.emulator is not None:
            self.emulator.launch(name, gx, bx, ctypes.c_char.from_address(address))  # type: ignore[arg-type]
        return self._done("cuLaunchKernel")

    def cuGraphCreate(self, flags: int) -> tuple[Any, ...]:
        self.graphs.append([])
        return self._done("cuGraphCreate", len(self.graphs))

    def cuGraphAddKernelNode(
        self, graph: int, after: list[int], count: int, parameters: NodeParameters
    ) -> tuple[Any, ...]:
        nodes = self.graphs[graph - 1]
        assert count == len(after) == min(len(nodes), 1)
        nodes.append(Node(parameters.kern, after))
        nodes[-1].take(parameters)
        return self._done("cuGraphAddKernelNode", len(nodes))

    def cuGraphInstantiate(self, graph: int, flags: int) -> tuple[Any, ...]:
        return self._done("cuGraphInstantiate", graph)

    def cuGraphExecKernelNodeSetParams(self, graph: int, node: int, parameters: NodeParameters) -> tuple[Any, ...]:
        self.changes += 1
        if "cuGraphExecKernelNodeSetParams" not in self.failing:
            self.graphs[graph - 1][node - 1].take(parameters)
        return self._done("cuGraphExecKernelNodeSetParams")

    def cuGraphLaunch(self, graph: int, stream: int) -> tuple[Any, ...]:
        self.replays.append(graph)
        for number, node in enumerate(self.graphs[graph - 1]):
            assert node.after == [number][:number]  # a chain
            assert node.argument is not None
            if self.emulator is not None:
                self.emulator.launch(self.names[node.kernel - 1], node.blocks, node.threads, node.argument)  # type: ignore[arg-type]
        return self._done("cuGraphLaunch")


def launcher(driver: FakeDriver, index: int = 0, stream: int = 0, code: bytes = b"\x7fELF") -> GpuLauncher:
    """Return the real launcher on top of a fake driver."""
    return GpuLauncher(
        torch.device("cuda", index),
        driver=driver,
        stream_of=lambda device: stream,
        architecture_of=lambda device: "sm_90",
        code_of=lambda name, arch: code + name.encode() + arch.encode(),
    )
