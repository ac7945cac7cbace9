"""Measure the host cost of an iteration with kernels that do nothing, and count its device operations.

Needs no GPU. Tensors are in host memory and so small that torch's time is its overhead. Kernel launches run the full
path to a driver that does nothing. A real GPU adds the driver's own time per launch.
"""

from __future__ import annotations

import os
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.gpu.bench import EmulatedBackend
from benchmarks.gpu.sass import listing
from benchmarks.iteration import steady
from benchmarks.kernel_usage import usage_of
from benchmarks.workload import PLACES, camera, room
from gs2d.config.presets import best, two_dgs_r
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import Recipe
from gs2d.data.scene import Scene, View
from gs2d.errors import BackendError
from gs2d.kernels.cuda import launch
from gs2d.kernels.cuda.compile import compile_source
from gs2d.render import pair_budget
from gs2d.render.cuda_backend import CudaBackend
from gs2d.training import objective, targets, trainer
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer, TrainerOptions

WAYS = ("torch", "launches", "graph")
SOURCES = tuple(
    f"cuda/{name}.cu"
    for name in "sort project emit order blend photometric losses blend_vjp blend_colors project_vjp adam".split()
)
SPLATS, WIDTH, HEIGHT = 256, 64, 48
# torch on a GPU: creating or viewing a tensor launches nothing; a radix sort launches one kernel per pass of
# 8 bits and five more (indices, histogram, offsets, two copies); every other operation launches one.
MADE = ("empty", "new_empty", "empty_like", "empty_strided")
LOOKED_AT = frozenset(
    "view slice select detach alias as_strided expand unsqueeze squeeze permute transpose t _unsafe_view "
    "_reshape_alias split unbind unfold diagonal lift_fresh requires_grad_ set_ is_same_size".split()
)


class NullDriver:
    """Stand-in for the functions of ``cuda.bindings.driver`` that a launch calls; nothing is executed."""

    CUresult = SimpleNamespace(CUDA_SUCCESS=0)
    CUfunction_attribute = SimpleNamespace(CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES=8)
    CUstream = CUfunction = CUkernel = staticmethod(int)
    CUDA_KERNEL_NODE_PARAMS = SimpleNamespace

    def __init__(self) -> None:
        self.launches = 0
        self.nodes = 0  # graph nodes that were updated before the launch
        self.kernels: dict[int, int] = {}  # nodes of a graph

    def cuDriverGetVersion(self) -> tuple[int, int]:
        return 0, 13000

    def cuGraphCreate(self, flags: int) -> tuple[int, int]:
        self.kernels[len(self.kernels) + 1] = 0
        return 0, len(self.kernels)

    def cuGraphAddKernelNode(self, graph: int, *_: Any) -> tuple[int, int]:
        self.kernels[graph] += 1
        return 0, self.kernels[graph]

    def cuGraphInstantiate(self, graph: int, flags: int) -> tuple[int, int]:
        return 0, graph

    def cuGraphExecKernelNodeSetParams(self, *_: Any) -> tuple[int]:
        self.nodes += 1
        return (0,)

    def cuGraphLaunch(self, executable: int, stream: int) -> tuple[int]:
        self.launches += self.kernels[executable]
        return (0,)

    def __getattr__(self, name: str) -> Callable[..., tuple[int, int]]:
        return lambda *_: (0, 1)

    def cuLaunchKernel(self, *_: Any) -> tuple[int]:
        self.launches += 1
        return (0,)


class OperationCount(TorchDispatchMode):
    """Count torch's operations by name, and the launches they would cause on a GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.names: Counter[str] = Counter()
        self.launches = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        self.names[name] += 1
        if name in ("sort", "argsort"):
            self.launches += 5 + args[0].element_size()
        elif name not in LOOKED_AT and name not in MADE and name != "randperm":  # host operations
            self.launches += 1
        return func(*args, **(kwargs or {}))


def _nothing_overflowed(budget: pair_budget.PairBudget) -> bool:
    budget._pending.clear()
    budget.overflow = None
    return False


@contextmanager
def nothing_runs() -> Iterator[NullDriver]:
    """Yield the cuda backend in host memory with a driver that does nothing; pair counts are not checked."""
    driver = NullDriver()
    launcher = launch.GpuLauncher(
        torch.device("cuda", 0),
        driver=driver,
        stream_of=lambda device: 1,
        architecture_of=lambda device: "sm_90",
        code_of=lambda name, arch: b"",
    )
    budget = pair_budget.PairBudget
    changed: list[tuple[Any, str, Any]] = [
        (launch, "launcher_for", lambda device: launcher),
        (trainer, "is_async", lambda device: True),
        (objective, "is_async", lambda device: True),
        (targets, "is_async", lambda device: True),
        (trainer, "validate", lambda recipe: recipe),  # the row group of stage 2 is created without ranking
        (budget, "room", lambda self, rendering: 1 << 10),
        (budget, "overflowed", _nothing_overflowed),
    ]
    before = [(where, name, getattr(where, name)) for where, name, _ in changed]
    for where, name, value in changed:
        setattr(where, name, value)
    try:
        yield driver
    finally:
        for where, name, value in before:
            setattr(where, name, value)


def null_trainer() -> Trainer:
    """Return a trainer of the 2DGS-R stages and the stage of ``best`` on a few splats, without densification or
    Progress.
    """
    splats = room(SPLATS)
    rng = np.random.default_rng(0)
    images = (rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in PLACES)
    views = tuple(
        View.from_arrays(f"{i}.png", camera(WIDTH, HEIGHT, place), image)
        for i, (place, image) in enumerate(zip(PLACES, images, strict=True))
    )
    bounds = np.array([[-3.0] * 3, [3.0] * 3])
    scene = Scene(name="null", format="blender", train=views, test=(), points=None, extent=3.0, bounds=bounds)
    stages = (*two_dgs_r().stages, replace(best().stages[0], name="best"))
    recipe = Recipe("null", tuple(replace(steady(stage), on_enter=()) for stage in stages))
    state = TrainState(splats, torch.Generator().manual_seed(0))
    state.groups["high_error"] = torch.arange(SPLATS) < SPLATS // 100 + 1
    return Trainer(
        scene,
        recipe,
        replace(GENERIC, near=0.2),
        backend=EmulatedBackend(),
        state=state,
        options=TrainerOptions(progress_every=10**9),
    )


@contextmanager
def iterations_by(way: str) -> Iterator[None]:
    """Run iterations through torch ("torch"), by "launches", by "graph", or as configured ("")."""
    before, takes = os.environ.get(launch.STEP_VARIABLE), CudaBackend.takes_whole_steps
    if way == "torch":
        CudaBackend.takes_whole_steps = lambda self: False  # type: ignore[method-assign]
    elif way:
        os.environ[launch.STEP_VARIABLE] = way
    try:
        yield
    finally:
        CudaBackend.takes_whole_steps = takes  # type: ignore[method-assign]
        if before is not None:
            os.environ[launch.STEP_VARIABLE] = before
        else:
            os.environ.pop(launch.STEP_VARIABLE, None)


def host_cost(repeats: int = 300, stages: int = 4, way: str = "") -> dict[str, Any]:
    """Measure by stage: host microseconds per iteration, launches, torch operations and allocations.

    ``way`` is as in :func:`iterations_by`.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    found: dict[str, Any] = {}
    try:
        with iterations_by(way), nothing_runs() as driver:
            made = null_trainer()
            for index, stage in enumerate(made.recipe.stages[:stages]):
                made.enter(index)
                for _ in range(3 * len(PLACES)):
                    made.step()
                found[stage.name] = {**_time(made, repeats), **_count(made, driver)}
    finally:
        torch.set_num_threads(threads)
    return found


def machine_code(arch: str = "sm_90") -> dict[str, Any]:
    """Return registers, shared memory, instructions and accesses of each iteration kernel; empty without a compiler."""
    try:
        code = {name: compile_source(name, arch) for name in SOURCES}
        kernels = {name: listing(made.code) for name, made in code.items()}
    except (BackendError, FileNotFoundError):
        return {}
    return {
        kernel: {
            "registers": usage.registers,
            "shared_bytes": usage.shared_bytes,
            "instructions": len(kernels[name][kernel].instructions),
            "accesses": kernels[name][kernel].accesses(),
        }
        for name, made in code.items()
        for kernel, usage in sorted(usage_of(made).items())
        if not kernel.endswith(("_32", "_abs", "distortion", "transmittance")) or kernel.endswith("pass_32")
    }


def _time(made: Trainer, repeats: int) -> dict[str, float]:
    """Time the thread, not the wall clock, so that other processes do not count."""
    times = []
    for _ in range(repeats):
        begun = time.thread_time_ns()
        made.step()
        times.append((time.thread_time_ns() - begun) / 1e3)
    return {"host_us": round(statistics.median(times), 1), "best_us": round(min(times), 1)}


def _count(made: Trainer, driver: NullDriver) -> dict[str, int]:
    """Count the operations of one iteration."""
    driver.launches = driver.nodes = 0
    with OperationCount() as count:
        made.step()
    allocations = sum(count.names[name] for name in MADE)
    return {
        "own_launches": driver.launches,
        "torch_operations": sum(count.names.values()) - allocations,
        "allocations": allocations,
        "device_launches": driver.launches + count.launches,
        "changed_nodes": driver.nodes,
    }


def table(found: dict[str, Any]) -> list[str]:
    """Return a line per stage."""
    return [f"{stage}: " + ", ".join(f"{name} {value}" for name, value in row.items()) for stage, row in found.items()]
