"""A chain of launches that the driver starts at once (a CUDA graph), made kernel by kernel instead of by recording.

What differs from one time to the next, cameras, learning rates, the room for pairs, is changed in the graph before it
is started: only for the launches of which it does differ.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

from gs2d.errors import BackendError
from gs2d.kernels.cuda.driver import call, driver_version, failure

__all__ = ["OLDEST_DRIVER", "Graph", "Work", "can_replay"]

OLDEST_DRIVER = (12, 0)  # from which a node takes a kernel of a library
NEEDED = (
    "CUDA_KERNEL_NODE_PARAMS",
    "cuGraphCreate",
    "cuGraphAddKernelNode",
    "cuGraphInstantiate",
    "cuGraphExecKernelNodeSetParams",
    "cuGraphLaunch",
)


class Work:
    """A launch that is made again and again, with arguments that stay where they are.

    Parameters
    ----------
    name : str
        The kernel.
    blocks, threads : int
        ``blocks`` may change, and be anything but 0.
    arguments : ctypes.Structure
        May be filled anew.
    """

    __slots__ = ("_pointer", "arguments", "blocks", "name", "parameters", "threads")

    def __init__(self, name: str, blocks: int, threads: int, arguments: ctypes.Structure) -> None:
        self.name, self.blocks, self.threads, self.arguments = name, blocks, threads, arguments
        self._pointer = ctypes.c_void_p(ctypes.addressof(arguments))
        self.parameters = ctypes.addressof(self._pointer)  # what the driver takes: where the pointers lie


def can_replay(driver: Any) -> bool:
    """Whether the driver and its bindings know graphs as they are made here."""
    if not all(hasattr(driver, name) for name in NEEDED):
        return False
    try:
        return driver_version(driver) >= OLDEST_DRIVER
    except BackendError:
        return False


class Graph:
    """Launches one after another.

    Parameters
    ----------
    driver : module
        ``cuda.bindings.driver``.
    kernels : sequence
        Handles of loaded kernels, one for each launch.
    works : sequence of Work
        As they are the first time.

    Raises
    ------
    BackendError
        The driver does not make it.
    """

    def __init__(self, driver: Any, kernels: Sequence[Any], works: Sequence[Work]) -> None:
        self._driver = driver
        graph = call(driver, "cuGraphCreate", 0)
        self._nodes: list[tuple[Any, Any]] = []  # node, its parameters
        self._sent: list[tuple[int, bytes]] = []  # what it has: blocks, arguments
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
        """Take over what differs from the last time.

        Raises
        ------
        BackendError
            The driver refuses; nothing was started.
        """
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
        """Start it, and return the driver's status at once."""
        return self._driver.cuGraphLaunch(self._executable, stream)[0]
