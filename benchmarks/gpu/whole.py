"""Check iterations by kernels alone (``gs2d.render.cuda_step``): run every kernel and compare with torch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch

from benchmarks.gpu.bench import Bench, rounded
from benchmarks.gpu.host import WAYS, iterations_by
from gs2d.config.protocols import GENERIC
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.kernels.cuda import launch
from gs2d.render.cuda_step import Stepper
from gs2d.render.pair_budget import PairBudget, Rendering
from gs2d.render.types import RasterSettings
from gs2d.render.whole_step import Learned, StepLosses, StepNormals, WholeStep
from gs2d.training import objective, targets, trainer

ROOM = 1 << 20  # pairs


def run_kernels(bench: Bench, splats: Splats, camera: Camera) -> None:
    """Train on images with and without alpha; more than 32767 tiles only on a GPU."""
    for channels in (3, 4):
        _step(bench, splats, camera, channels)
    if not bench.dry:
        few = splats.rows(torch.arange(20, device=bench.device))
        _step(bench, few, camera.resized(16, 16 * 32768), 3)


def _step(bench: Bench, splats: Splats, camera: Camera, channels: int) -> None:
    splats = splats.clone()
    learned = {
        name: Learned(torch.zeros_like(tensor), torch.zeros_like(tensor), 1e-3, 1, None)
        for name, tensor in splats.items()
    }
    size = camera.height, camera.width, channels
    step = WholeStep(
        splats=splats,
        camera=camera,
        settings=RasterSettings(with_distortion=False),
        photograph=torch.randint(0, 256, size, device=bench.device, dtype=torch.uint8),
        mask=None,
        valid=camera.height * camera.width,
        background=(0.0, 0.0, 0.0),
        losses=StepLosses(
            0.8,
            0.2,
            silhouette=0.1 if channels == 4 else None,
            normals=StepNormals(0.05, "mean", at_camera=False, of_object=True),
        ),
        rows=None,
        learned=learned,
        betas=(0.9, 0.999, 1e-15),
        gathered={},
    )
    budget = PairBudget()
    budget.learn(Rendering(-(-camera.width // 16) * -(-camera.height // 16)), ROOM)
    done = Stepper(launch.launcher_for(bench.device), bench.device).run(step, budget)
    assert done
    assert not budget.overflowed(), "more pairs than a scene for sanitizers has"


@contextmanager
def _way(chosen: str, dry: bool) -> Iterator[None]:
    """Run iterations in one mode; with ``dry``, treat the emulated device as asynchronous."""
    asked = objective.is_async
    places: tuple[Any, ...] = (trainer, objective, targets)
    for place in places if dry else ():
        place.is_async = lambda device: True
    try:
        with iterations_by(chosen):
            yield
    finally:
        for place in places:
            place.is_async = asked


def differences(bench: Bench) -> dict[str, Any]:
    """Compare the modes on a stage: parameter difference to the torch run, relative to the norm of the update."""
    import train_toys  # of tests/helpers

    recipe = train_toys.short()
    first = recipe.stages[0]
    assert first.densify is not None
    iterations = 6 if bench.dry else 60
    quiet = replace(
        first, iterations=iterations, densify=replace(first.densify, start=10**5, stop=10**6, reset_every=0)
    )
    scene, ends = train_toys.make_scene(), {}
    for chosen in WAYS:
        with _way(chosen, bench.dry):
            made = trainer.Trainer(
                scene,
                replace(recipe, stages=(quiet,)),
                GENERIC,
                backend=bench.backend,
                options=trainer.TrainerOptions(progress_every=1000),
            )
            start = made.splats.clone()
            made.run()
            ends[chosen] = made.splats
    moved = {name: float((tensor - getattr(start, name)).norm()) for name, tensor in ends["torch"].items()}
    return {
        chosen: rounded(
            {
                name: float((tensor - getattr(ends["torch"], name)).norm()) / max(moved[name], 1e-30)
                for name, tensor in ends[chosen].items()
            }
        )
        for chosen in WAYS[1:]
    }
