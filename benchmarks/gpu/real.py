"""Profile iterations of trainings on real captures, whose tile lists are less uniform than those of synthetic scenes.

Trains a capture with a recipe. At several points of the schedule, measures milliseconds of an iteration and of the
host, microseconds per kernel, and tile list lengths.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gpu.bench import Bench, kernel_times
from benchmarks.gpu.first import TRACED, timed
from gs2d.config.presets import get_recipe
from gs2d.config.schedule import scale_schedule
from gs2d.data import load_scene
from gs2d.data.known_captures import protocol_for
from gs2d.render import cuda_passes
from gs2d.training.trainer import Trainer, TrainerOptions

PARTS = (0.1, 0.5, 0.9)  # fractions of the schedule
MEASURED = 100  # iterations


def run(bench: Bench, captures: list[Path], recipe: str, scale: float, downscale: int, progress: Any) -> dict[str, Any]:
    """Measure every capture; ``progress`` gets the document after each part."""
    found: dict[str, Any] = {}
    for capture in captures:
        rows: dict[str, Any] = found.setdefault(capture.resolve().name, {})
        told = partial(progress, found)
        work = partial(of_capture, bench, capture, (recipe, scale, downscale), rows, told)
        rows |= bench.attempt(capture.name, work)
        told()
    return found


def of_capture(
    bench: Bench, capture: Path, asked: tuple[str, float, int], rows: dict[str, Any], told: Any
) -> dict[str, Any]:
    """Train the recipe's first stage and measure at several points."""
    (recipe, scale, downscale), begun = asked, time.perf_counter()
    scene = load_scene(capture, downscale=downscale)
    steps = scale_schedule(get_recipe(recipe), scale)
    steps = replace(steps, init_points=60, dense_start=None) if bench.dry else steps
    trainer = Trainer(
        scene, steps, protocol_for(scene.format), backend=bench.backend, options=TrainerOptions(progress_every=50)
    )
    trainer.enter(0)
    bench.wait()
    rows["seconds_until_training"] = round(time.perf_counter() - begun, 2)
    rows["size"] = [scene.train[0].camera.width, scene.train[0].camera.height]
    stage, begun = steps.stages[0], time.perf_counter()
    for part in PARTS:
        while trainer.state.step < round(part * stage.iterations):
            trainer.step()
        bench.wait()
        seconds = time.perf_counter() - begun
        row = {"iteration": trainer.state.step, "seconds": round(seconds, 2), "splats": len(trainer.splats)}
        row |= timed(bench, trainer, 1 if bench.dry else MEASURED)
        row |= {} if bench.dry else {"kernels_us": kernel_times(bench, trainer.step, TRACED)}
        rows[f"{part:g}"] = row | lists(bench, trainer)
        told()
        begun = time.perf_counter() - seconds
    return {}


def lists(bench: Bench, trainer: Trainer) -> dict[str, Any]:
    """Return pair counts and tile list lengths of some views."""
    pairs, longest, spread = [], [], []
    for view in trainer.scene.train[:: max(1, len(trainer.scene.train) // 4)]:
        parameters = {name: tensor.detach().contiguous() for name, tensor in trainer.splats.items()}
        given = cuda_passes.view_of(view.camera, trainer.settings)
        ranges = cuda_passes.forward(bench.launcher, given, parameters, distortion=False).ranges.cpu().numpy()
        lengths = (ranges[..., 1] - ranges[..., 0]).ravel()[:-1]
        pairs.append(int(lengths.sum()))
        longest.append(int(lengths.max()))
        spread.append(np.quantile(lengths, (0.5, 0.9, 0.99)))
    return {"pairs": pairs, "longest_list": longest, "lists_50_90_99": np.mean(spread, axis=0).round().tolist()}


def table(found: dict[str, Any]) -> list[str]:
    """Return a line per capture and point."""
    lines = []
    for name, rows in found.items():
        for part, row in rows.items():
            if isinstance(row, dict):
                most = list(row.get("kernels_us", {}).items())[:6]
                lines.append(
                    f"{name} {part}: {row.get('iteration_ms')} ms, {row['splats']} splats, {most}, "
                    f"lists {row['lists_50_90_99']}, longest {max(row['longest_list'])}"
                )
        if "failed" in rows:
            lines.append(f"{name}: {rows['failed']}")
    return lines
