"""A sequence of launches as a CUDA graph, built from kernel nodes instead of stream capture.

Before each start, the nodes whose arguments changed (camera, learning rates, room for pairs) are updated.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

from gs2d.kernels.cuda.driver import call, failure


class Work:
    """A launch that is repeated with the same argument structure.

    Arguments and ``blocks``, which must not be 0, may be changed between launches.
    """

    __slots__ = ("_pointer", "arguments", "blocks", "name", "parameters", "threads")

    def __init__(self, name: str, blocks: int, threads: int, arguments: ctypes.Structure) -> None:
        self.name, self.blocks, self.threads, self.arguments = name, blocks, threads, arguments
        self._pointer = ctypes.c_void_p(ctypes.addressof(arguments))
        self.parameters = ctypes.addressof(self._pointer)  # address of the array of pointers for the driver


class Graph:
    """A graph of sequential launches, with the handle of a loaded kernel for each of them.

    ``driver`` is the module ``cuda.bindings.driver``. Raises BackendError if it cannot create the graph.
    """

    def __init__(self, driver: Any, kernels: Sequence[Any], works: Sequence[Work]) -> None:
        self._driver = driver
        graph = call(driver, "cuGraphCreate", 0)
        self._nodes: list[tuple[Any, Any]] = []  # node and its parameters
        self._sent: list[tuple[int, bytes]] = []  # blocks and arguments of each node
        before: list[Any] = []
        for kernel, work in zip(kernels, works, strict=True):
            parameters = driver.CUDA_KERNEL_NODE_PARAMS()
            parameters.kern = driver.CUkernel(int(kernel))
            parameters.gridDimX, parameters.gridDimY, parameters.gridDimZ = work.blocks, 1, 1
            parameters.blockDimX, parameters.blockDimY, parameters.blockDimZ = work.threads, 1, 1
            parameters.sharedMemBytes, parameters.extra = 0, 0
            parameters.kernelParams = work.parameters
            before = [call(driver, "cuGraphAddKernelNode", graph, before, len(before), parameters)]
            self._nodes.append((before[0], parameters))
            self._sent.append((work.blocks, bytes(work.arguments)))
        self._graph = graph
        self._executable = call(driver, "cuGraphInstantiate", graph, 0)

    def change(self, works: Sequence[Work]) -> None:
        """Update the nodes whose launch changed; BackendError if the driver refuses."""
        driver, executable, success = self._driver, self._executable, self._driver.CUresult.CUDA_SUCCESS
        for number, work in enumerate(works):
            now = work.blocks, bytes(work.arguments)
            if now == self._sent[number]:
                continue
            node, parameters = self._nodes[number]
            parameters.gridDimX, parameters.kernelParams = work.blocks, work.parameters
            status = driver.cuGraphExecKernelNodeSetParams(executable, node, parameters)[0]
            if status != success:
                raise failure("cuGraphExecKernelNodeSetParams", status)
            self._sent[number] = now

    def launch(self, stream: Any) -> Any:
        """Start the graph and return the driver's status without waiting."""
        return self._driver.cuGraphLaunch(self._executable, stream)[0]
