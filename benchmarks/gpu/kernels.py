"""Command 1: measure the kernels against their lower bounds, and iterations next to other rasterizers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.gpu.bench import Bench, TimingLauncher, kernel_times
from benchmarks.gpu.peers import PEERS, PeerIteration
from benchmarks.gpu.scenes import SIZES, TOY, GpuScene, gpu_scene, scene_name
from benchmarks.iteration import steady
from gs2d.config.presets import two_dgs_r
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import Recipe
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene, View
from gs2d.errors import BackendError
from gs2d.render import cuda_passes
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.types import RasterSettings
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer, TrainerOptions

SETTINGS = RasterSettings()
Parts = Iterator[tuple[str, Callable[[], dict[str, Any]]]]  # run in this order
REPEATS, WARMUP = 50, 10
# Computed for the design (not measured): milliseconds at the issue limit of an H200, scene A.
FLOORS = {
    (1_000_000, 1600): {
        "project_splats": 0.08,
        "blend_forward_distortion": 0.33,
        "blend_vjp_geometry": 0.79,
        "project_splats_vjp": 0.125,
        "adam_step": 0.38,
    },
    (100_000, 800): {
        "project_splats": 0.01,
        "blend_forward_distortion": 0.08,
        "blend_vjp_geometry": 0.19,
        "project_splats_vjp": 0.013,
        "adam_step": 0.04,
    },
}
# Instructions of a warp per visited splat, and per touched half of the warp's pixels, counted in the
# compiled code of the design prototype.
INSTRUCTIONS = {"blend_forward": (20, 50), "blend_vjp": (108, 77)}


def run(bench: Bench, only: list[str], progress: Any) -> dict[str, Any]:
    """Measure all scenes, then all scenes with other rasterizers; ``progress`` gets the document after each part.

    Other rasterizers run last: they may compile for minutes, or cause an error that ends GPU work in this process.
    """
    sizes = [(*size, spread) for size in (TOY if bench.dry else SIZES) for spread in ("A" if bench.dry else "AB")]
    chosen = [size for size in sizes if not only or any(word in scene_name(*size) for word in only)]
    found: dict[str, Any] = {scene_name(*size): {} for size in chosen}
    report = partial(progress, found)
    for kind in (measure_scene, measure_peers):
        for size in chosen:
            result = found[scene_name(*size)]
            stopped = bench.attempt(kind.__name__, partial(_through, bench, kind(bench, *size, result), result, report))
            if stopped:  # a scene-level error: the scene could not be made, or no time was left
                result[kind.__name__] = stopped
            report()
            if not bench.dry:
                with suppress(RuntimeError):  # a pending error of an earlier part
                    torch.cuda.empty_cache()
    return found


def _through(bench: Bench, parts: Parts, result: dict[str, Any], progress: Any) -> dict[str, Any]:
    for name, work in parts:
        result[name] = bench.attempt(name, work)
        progress()
    return {}


def _scene(bench: Bench, count: int, width: int, height: int, spread: str) -> GpuScene:
    scene = gpu_scene(count, width, height, spread, bench.device)
    return replace(scene, cameras=scene.cameras[:1]) if bench.dry else scene


def measure_scene(bench: Bench, count: int, width: int, height: int, spread: str, result: dict[str, Any]) -> Parts:
    """Measure counts, kernels, passes and iterations of one scene."""
    scene = _scene(bench, count, width, height, spread)
    yield "counts", lambda: counts(bench, scene)
    yield "kernels_ms", lambda: kernels(bench, scene)
    yield "passes", lambda: passes(bench, scene)
    yield "sorts_ms", lambda: sorts(bench, scene)
    yield "iteration", lambda: iterations(bench, scene, images(bench, scene))
    times = result["iteration"].get("surface_kernels_ms", {}) | result["kernels_ms"]
    floors = {name: floor for name, floor in FLOORS.get((count, width), {}).items() if name in times}
    yield "floors_ms", lambda: floors
    yield "times_floor", lambda: {name: round(times[name] / floor, 3) for name, floor in floors.items()}


def measure_peers(bench: Bench, count: int, width: int, height: int, spread: str, result: dict[str, Any]) -> Parts:
    """Measure other rasterizers on one scene, and repeat one of our iterations next to them."""
    if not any(installed(name) for name in PEERS):
        yield from ((name, lambda name=name: peer(bench, None, [], name)) for name in PEERS)
        return
    scene = _scene(bench, count, width, height, spread)
    targets = images(bench, scene)
    yield "iteration_beside_peers", lambda: iterations(bench, scene, targets, stages=1)
    ours = result["iteration_beside_peers"].get("surface", {}).get("median")
    for name in PEERS:
        yield name, lambda name=name: peer(bench, scene, targets, name)
        theirs = result[name].get("iteration_ms", {}).get("median")
        if ours and theirs:
            result[f"times_faster_than_{name}"] = round(theirs / ours, 2)


def parameters(scene: GpuScene) -> dict[str, Tensor]:
    """Return the parameters in the form that the passes take."""
    return {name: tensor.detach().contiguous() for name, tensor in scene.splats.items()}


def counts(bench: Bench, scene: GpuScene) -> dict[str, Any]:
    """Count the work of one view, and the instructions that the design computes for it."""
    frame = cuda_passes.forward(bench.launcher, cuda_passes.view_of(scene.cameras[0], SETTINGS), parameters(scene))
    seen = frame.seen.cpu().numpy().view(np.uint32)  # [words, 8]
    below = [(warp >> 1) * 4 + (warp & 1) for warp in range(4)]  # upper half of a warp; the lower half is two further
    visits = sum(_bits(seen[:, b] | seen[:, b + 2]) for b in below)
    halves = _bits(seen)
    drawn = int((frame.radii > 0).sum())
    by_kernel = {name: visits * a + halves * b for name, (a, b) in INSTRUCTIONS.items()}
    return {
        "splats_drawn": drawn,
        "candidates": len(frame.entries),
        "visits": visits,
        "halves": halves,
        "warp_instructions_model": by_kernel,
    }


def _bits(words: np.ndarray) -> int:
    """Return the number of set bits (numpy has a function for this only from 2.0 on)."""
    return int(np.unpackbits(np.ascontiguousarray(words).view(np.uint8)).sum(dtype=np.int64))


def kernels(bench: Bench, scene: GpuScene) -> dict[str, float]:
    """Return the median time per kernel over the views, from events; all images except distortion have gradients."""
    timing = TimingLauncher(bench.launcher, bench.dry)
    backend = CudaBackend(launcher=timing)
    repeats, warmup = (2, 0) if bench.dry else (REPEATS, WARMUP)
    leaves = Splats(**{name: tensor.detach().requires_grad_() for name, tensor in scene.splats.items()})
    for i in range(warmup + repeats):
        camera = scene.cameras[i % len(scene.cameras)]
        output = backend.rasterize(leaves, camera, SETTINGS)
        (output.color.mean() + output.normal.mean() + output.depth_mean.mean()).backward()
        for _, tensor in leaves.items():
            tensor.grad = None
        with torch.no_grad():
            backend.splat_errors(scene.splats, camera, output.color.detach(), SETTINGS)
    bench.wait()
    return timing.medians(skip=warmup)


def passes(bench: Bench, scene: GpuScene) -> dict[str, Any]:
    """Time the public function: forward alone, and forward with backward; and its memory."""
    leaves = Splats(**{name: tensor.detach().requires_grad_() for name, tensor in scene.splats.items()})
    backend = CudaBackend(launcher=bench.launcher)

    def forward(i: int) -> None:
        with torch.no_grad():
            backend.rasterize(scene.splats, scene.cameras[i % len(scene.cameras)], SETTINGS)

    def both(i: int) -> None:
        output = backend.rasterize(leaves, scene.cameras[i % len(scene.cameras)], SETTINGS)
        (output.color.mean() + output.normal.mean() + output.depth_mean.mean()).backward()
        for _, tensor in leaves.items():
            tensor.grad = None

    return {
        "forward_ms": bench.times(forward, repeats=REPEATS, warmup=WARMUP),
        "forward_backward_ms": bench.times(both, repeats=REPEATS, warmup=WARMUP),
        "peak_bytes": bench.peak_memory(lambda: both(0)),
    }


def sorts(bench: Bench, scene: GpuScene) -> dict[str, Any]:
    """Time torch.sort with the arguments and sizes of the passes on this scene."""
    frame = cuda_passes.forward(bench.launcher, cuda_passes.view_of(scene.cameras[0], SETTINGS), parameters(scene))
    count, entries = len(scene.splats), max(len(frame.entries), 1)
    depth = torch.randint(0, 1 << 30, (count,), dtype=torch.int32, device=bench.device)
    found = {"depth_int32": bench.times(lambda _: torch.sort(depth, stable=True), repeats=REPEATS, warmup=WARMUP)}
    for dtype in (torch.int16, torch.int32):
        keys = torch.randint(0, 1 << 14, (entries,), dtype=dtype, device=bench.device)
        name = f"tile_{str(dtype).removeprefix('torch.')}"
        found[name] = bench.times(lambda _, keys=keys: torch.sort(keys, stable=True), repeats=REPEATS, warmup=WARMUP)
    return found


def images(bench: Bench, scene: GpuScene) -> list[Tensor]:
    """Return target images [H, W, 3] of the cameras, in [0, 1]."""
    with torch.no_grad():
        return [
            CudaBackend(launcher=bench.launcher).rasterize(scene.splats, camera, SETTINGS).color.clamp(0, 1)
            for camera in scene.cameras
        ]


def disturbed(splats: Splats) -> Splats:
    """Return the splats with other colours, so that there is something to learn."""
    start = splats.clone()
    noise = torch.randn(start.sh0.shape, generator=torch.Generator().manual_seed(2))
    start.sh0 += 0.2 * noise.to(start.sh0)
    return start


def iterations(bench: Bench, scene: GpuScene, targets: list[Tensor], *, stages: int = 3) -> dict[str, Any]:
    """Time whole trainer iterations in the stages of 2DGS-R with all losses, without densification."""
    trainer = bench_trainer(bench, scene, targets, stages=stages)
    found: dict[str, Any] = {}
    for index, stage in enumerate(trainer.recipe.stages):
        trainer.enter(index)
        for _ in scene.cameras:
            trainer.step()  # every training image has been loaded
        found[stage.name] = bench.times(lambda _: trainer.step(), repeats=REPEATS, warmup=WARMUP)
        found[f"{stage.name}_peak_bytes"] = bench.peak_memory(trainer.step)
        found[f"{stage.name}_kernels_ms"] = _in_iterations(bench, trainer)
    return found


def bench_trainer(bench: Bench, scene: GpuScene, targets: list[Tensor] | None = None, *, stages: int = 3) -> Trainer:
    """Return a 2DGS-R trainer that fits renderings of the splats; all iterations do the same work."""
    targets = images(bench, scene) if targets is None else targets
    views = tuple(
        View.from_arrays(f"{i}.png", camera, (target * 255).round().byte().cpu().numpy())
        for i, (camera, target) in enumerate(zip(scene.cameras, targets, strict=True))
    )
    bounds = np.array([[-3.0] * 3, [3.0] * 3])
    capture = Scene(name=scene.name, format="blender", train=views, test=(), points=None, extent=3.0, bounds=bounds)
    recipe = two_dgs_r()
    recipe = Recipe("bench", tuple(steady(stage) for stage in recipe.stages[:stages]))
    protocol = replace(GENERIC, near=0.2)
    state = TrainState(disturbed(scene.splats), torch.Generator().manual_seed(2))
    return Trainer(
        capture, recipe, protocol, backend=bench.backend, state=state, options=TrainerOptions(progress_every=10**9)
    )


def _in_iterations(bench: Bench, trainer: Trainer) -> dict[str, float]:
    """Return the milliseconds per kernel in the trainer's iterations, including losses and Adam."""
    if not bench.dry:  # graph launches bypass the launcher
        return {name: value / 1e3 for name, value in kernel_times(bench, trainer.step, WARMUP).items()}
    timing = TimingLauncher(bench.launcher, bench.dry)
    with bench.replaced(timing):
        trainer.step()
    return timing.medians(skip=0)


def installed(name: str) -> bool:
    """Return True if the package can be imported."""
    try:
        PEERS[name]()
    except BackendError:
        return False
    return True


def peer(bench: Bench, scene: GpuScene | None, targets: list[Tensor], name: str) -> dict[str, Any]:
    """Render the same splats and views with another rasterizer."""
    found = PEERS[name]()
    if scene is None:
        return {"skipped": "peers need a GPU"}
    trainer = PeerIteration(found, disturbed(scene.splats), targets)

    def forward(i: int) -> None:
        with torch.no_grad():
            trainer.forward(scene.cameras[i % len(scene.cameras)])

    def both(i: int) -> None:
        trainer.forward(scene.cameras[i % len(scene.cameras)]).mean().backward()
        for leaf in trainer.leaves.values():
            leaf.grad = None

    def step(i: int) -> None:
        trainer.step(scene.cameras[i % len(scene.cameras)], i % len(targets))

    difference = (trainer.forward(scene.cameras[0]).color.detach() - targets[0]).abs()
    return {
        "version": found.version,
        "ssim": trainer.ssim,
        "mean_difference_of_disturbed_colors": round(float(difference.mean()), 5),
        "forward_ms": bench.times(forward, repeats=REPEATS, warmup=WARMUP),
        "forward_backward_ms": bench.times(both, repeats=REPEATS, warmup=WARMUP),
        "iteration_ms": bench.times(step, repeats=REPEATS, warmup=WARMUP),
        "peak_bytes": bench.peak_memory(lambda: step(0)),
    }


def table(found: dict[str, Any]) -> list[str]:
    """Return a short table."""
    lines = []
    for name, scene in found.items():
        iteration = scene.get("iteration", {}).get("surface", {})
        times = {name: time for name, time in scene.get("kernels_ms", {}).items() if isinstance(time, float)}
        slow = sorted(times.items(), key=lambda item: -item[1])[:3]
        why = {p: next(iter(scene.get(p, {}).values()), "?") for p in PEERS}  # the error
        peers = ", ".join(f"{p}: {scene.get(f'times_faster_than_{p}', why[p])}" for p in PEERS)
        lines.append(f"{name}: iteration {iteration.get('median', '?')} ms; {dict(slow)}; times faster than {peers}")
    return lines


__all__ = ["run", "table"]
