"""Time one workload stage by stage, with exact counts of its work and its memory."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.memory import ViewWork
from benchmarks.timing import Probe, Timing, probe, summary
from benchmarks.workload import Workload
from gs2d.config.presets import two_dgs_r
from gs2d.config.recipe import GradDensify
from gs2d.core.splats import IMAGES, Splats
from gs2d.kernels.library import Library
from gs2d.kernels.loss_operations import NormalOptions
from gs2d.kernels.native_losses import NativeLosses
from gs2d.render.backends import get_backend
from gs2d.render.cpu_backend import CpuBackend
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.training.densify.gradient import densify_and_prune
from gs2d.training.optimizer import adam_step, begin_stage
from gs2d.training.state import TrainState

NATIVE = ("project", "sort", "bin", "blend_forward", "index_slots", "blend_backward", "project_backward")
FORWARD_STAGES = 4  # indices into NATIVE; the others belong to the backward pass
LIMIT_REPEATS = 200


@dataclass(frozen=True)
class Measured:
    """Times by step, counts of the view, and the best probe between the steps."""

    steps: dict[str, Timing]
    work: ViewWork
    frame_bytes: int
    probe: Probe


def stage_times(library: Library) -> list[float]:
    """Return milliseconds of this thread's last forward and backward pass, in the order of NATIVE."""
    buffer = (ctypes.c_int64 * 16)()
    count = library.call("gs2d_stage_times", buffer)
    if count != len(NATIVE):
        raise RuntimeError(f"the native library times {count} stages, expected {len(NATIVE)}; rebuild it")
    return [1e-6 * ns for ns in buffer[:count]]


def trim(library: Library) -> None:
    """Free the buffers that the library keeps for the next view."""
    library.call("gs2d_trim")


def frame_bytes(library: Library, output: RenderOutput) -> int:
    """Return the bytes that a view currently holds."""
    node: Any = output.color.grad_fn
    return int(library.call("gs2d_frame_bytes", node.state.pointer))


def count_work(library: Library, output: RenderOutput, splats: int) -> ViewWork:
    """Count the work of the rendered view; after the backward pass, also of its largest chunk."""
    node: Any = output.color.grad_fn
    counts = (ctypes.c_int64 * 6)()
    if library.call("gs2d_frame_counts", node.state.pointer, counts) != 0:
        raise MemoryError("no memory to count the pairs of a view")
    pairs, lanes, entries, slots, visible, chunk = counts
    height, width = output.alpha.shape
    return ViewWork(splats, visible, entries, slots, pairs, lanes, width, height, chunk)


class Passes:
    """Repeatable forward and backward passes of all outputs, or of colour alone, on one workload."""

    def __init__(self, library: Library, workload: Workload, sh_degree: int, *, probe_columns: int = 2) -> None:
        self.library, self.camera = library, workload.cameras[0]
        self.settings = RasterSettings(sh_degree=sh_degree)
        self.leaves = Splats(**{name: t.detach().clone().requires_grad_() for name, t in workload.splats.items()})
        self.signal = torch.zeros(len(self.leaves), probe_columns, requires_grad=True)
        self.cotangents: list[Tensor] = []

    def forward(self) -> RenderOutput:
        """Render."""
        return CpuBackend(self.library).rasterize(self.leaves, self.camera, self.settings, self.signal)

    def backward(self, output: RenderOutput) -> None:
        """Compute gradients of every parameter and the densification signal."""
        images = [getattr(output, name) for name in IMAGES]
        if not self.cotangents:
            generator = torch.Generator().manual_seed(1)
            self.cotangents = [torch.randn(image.shape, generator=generator) for image in images]
        torch.autograd.grad(images, [*(t for _, t in self.leaves.items()), self.signal], self.cotangents)

    def times(self, seconds: float, least: int) -> dict[str, list[float]]:
        """Return milliseconds by native stage, and of both passes measured in Python."""
        self.backward(self.forward())
        rows: dict[str, list[float]] = {name: [] for name in (*NATIVE, "raster_forward", "raster_backward")}
        end = time.perf_counter() + seconds
        count = 0
        while count < least or (time.perf_counter() < end and count < LIMIT_REPEATS):
            start = time.perf_counter()
            output = self.forward()
            middle = time.perf_counter()
            self.backward(output)
            finish = time.perf_counter()
            rows["raster_forward"].append(1e3 * (middle - start))
            rows["raster_backward"].append(1e3 * (finish - middle))
            for name, value in zip(NATIVE, stage_times(self.library), strict=True):
                rows[name].append(value)
            count += 1
        return rows


def repeated(work: Callable[[], float], seconds: float, least: int) -> Timing:
    """Summarise a function that returns its own milliseconds, without the first call."""
    work()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < least or (time.perf_counter() < end and len(times) < LIMIT_REPEATS):
        times.append(work())
    return summary(times)


def loss_step(output: RenderOutput, workload: Workload) -> Callable[[], float]:
    """Return a step of L1 + SSIM, normal consistency and mean distortion, forward and backward, as in training."""
    names = ("color", "normal", "depth_mean", "distortion")
    leaves = {name: getattr(output, name).detach().clone().requires_grad_() for name in names}
    alpha, camera = output.alpha.detach(), workload.cameras[0]
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(leaves["color"].shape, generator=generator)
    target = (leaves["color"].detach() + 0.1 * noise).clamp(0, 1)
    ops = NativeLosses()
    mean = ops.blur(target)

    def step() -> float:
        start = time.perf_counter()
        l1, ssim, _ = ops.photometric(leaves["color"], target, None, mean)
        normal = ops.normal_consistency(leaves["normal"], leaves["depth_mean"], alpha, NormalOptions(camera))
        total = 0.8 * l1 - 0.2 * ssim + 0.05 * normal + 100.0 * ops.masked_mean(leaves["distortion"], None)
        torch.autograd.grad(total, list(leaves.values()))
        return 1e3 * (time.perf_counter() - start)

    return step


def optimizer_step(workload: Workload) -> Callable[[], float]:
    """Return a step of Adam on every attribute of every splat."""
    stage = two_dgs_r().stages[0]
    state = TrainState(workload.splats.clone(), torch.Generator().manual_seed(4))
    begin_stage(state, stage)
    gradients = {name: torch.randn(t.shape, generator=state.generator) for name, t in state.splats.items()}
    lr, backend = dict.fromkeys(gradients, 1e-4), get_backend("cpu")

    def step() -> float:
        start = time.perf_counter()
        adam_step(state, stage, gradients, lr, backend=backend)
        return 1e3 * (time.perf_counter() - start)

    return step


def densification_case(splats: Splats) -> Callable[[], object]:
    """Return a densification in which 5 % of the splats pass the threshold; the larger half of them is split."""
    stage = two_dgs_r().stages[0]
    assert isinstance(stage.densify, GradDensify)
    size = float(splats.scales.amax(dim=1).median())
    densify = replace(stage.densify, percent_dense=size)  # for an extent of 1
    n = len(splats)
    passes = torch.rand(n, generator=torch.Generator().manual_seed(5)) < 0.05
    signal = torch.where(passes, 2.0, 0.5) * densify.grad_threshold
    state = TrainState(splats.clone(), torch.Generator().manual_seed(6))
    begin_stage(state, stage)
    state.statistics = {"signed": signal, "absolute": signal.clone(), "count": torch.ones(n)}
    return partial(densify_and_prune, state, densify, iteration=600, extent=1.0, white=False)


def densification_step(workload: Workload) -> Callable[[], float]:
    """Return a densification step that starts from the same state each time."""

    def step() -> float:
        work = densification_case(workload.splats)
        start = time.perf_counter()
        work()
        return 1e3 * (time.perf_counter() - start)

    return step


def measure_stages(library: Library, workload: Workload, seconds: float, least: int) -> Measured:
    """Time every step of a training iteration alone, for ``seconds`` or ``least`` repeats, whichever takes longer."""
    best = probe(library)
    trim(library)
    passes = Passes(library, workload, 3)
    output = passes.forward()
    passes.backward(output)
    work = count_work(library, output, len(workload.splats))
    held = frame_bytes(library, output)
    losses = loss_step(output, workload)
    del output
    times = passes.times(seconds, least)
    best = best.better(probe(library))
    steps = {name: summary(values) for name, values in times.items()}
    flat = Passes(library, workload, 0).times(seconds / 3, least)
    for name, stage in (("sh_forward", "project"), ("sh_backward", "project_backward")):
        low = summary(flat[stage])
        full = steps[stage]  # SH is evaluated during projection: the cost of degree 3 over degree 0
        difference = max(0.0, full.median - low.median)
        spread = (full.spread**2 + low.spread**2) ** 0.5
        steps[name] = Timing(difference, max(0.0, full.best - low.best), full.repeats, spread)
    del passes
    trim(library)
    steps["losses"] = repeated(losses, seconds / 3, least)
    best = best.better(probe(library))
    steps["optimizer"] = repeated(optimizer_step(workload), seconds / 3, least)
    steps["densification"] = repeated(densification_step(workload), seconds / 3, least)
    return Measured(steps, work, held, best.better(probe(library)))
