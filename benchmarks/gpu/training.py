"""Command 2: train 2DGS-R on the GPU through the user-facing API, and report metrics."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.gpu.bench import ROOT, Bench
from benchmarks.gpu.capture import SYNTHETIC, write_capture
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Phase, StageScored

RECIPE = "2dgs-r"  # the paper's three stages; the time goals refer to it
STAGE = ("name", "iterations", "seconds", "splats", "bytes", "train", "test")


def run(
    bench: Bench,
    captures: list[Path],
    scale: float,
    downscale: int,
    out: Path | None,
    progress: Any,
    *,
    synthetic: bool = False,
) -> dict[str, Any]:
    """Train every capture, then a synthetic one; ``progress`` gets the document after each stage."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if out is None else out
        if bench.dry:
            captures, scale = [toy_capture(Path(temporary))], 0.0005
        jobs: dict[str, Any] = {capture.resolve().name: lambda capture=capture: capture for capture in captures}
        if synthetic:
            jobs[SYNTHETIC] = lambda: write_capture(bench, Path(temporary) / SYNTHETIC)
        for name, make in jobs.items():

            def report(partial: dict[str, Any], name: str = name) -> None:
                found[name] = partial
                progress(found)

            def work(make: Any = make, report: Any = report) -> dict[str, Any]:
                return whole_run(bench, make(), scale, downscale, folder, report)

            result = bench.attempt(name, work)
            report(found.get(name, {}) | result if "failed" in result else result)
    return found


def toy_capture(folder: Path) -> Path:
    """Return the tests' ball capture, 24 x 24 px."""
    import sys

    sys.path.insert(0, str(ROOT / "tests" / "helpers"))
    import tiny

    return Path(tiny.write_capture(folder / "ball"))


def whole_run(
    bench: Bench, capture: Path, scale: float, downscale: int, folder: Path, report: Any = lambda partial: None
) -> dict[str, Any]:
    """Train to the end; return stage times without loading and scoring, quality, memory, and the total time.

    ``report`` gets the stages after each, so that an interrupted run keeps its results.
    """
    overrides = ("init_points=60", "surface.densify.max_splats=90") if bench.dry else ()
    options = TrainOptions(
        scene=capture,
        recipe=RECIPE,
        out=folder / f"run-{capture.resolve().name}",
        backend="cuda",
        downscale=downscale,
        schedule_scale=scale,
        overrides=overrides,
        checkpoint_every=10**9,
    )
    if not bench.dry:
        torch.cuda.reset_peak_memory_stats()
    phases: dict[str, float] = {}
    started = [("start", time.perf_counter())]

    ended: list[dict[str, Any]] = []

    def on_event(event: Any) -> None:
        if isinstance(event, StageScored):
            ended.append({k: event.metrics.get(k) for k in STAGE})
            report({"schedule_scale": scale, "unfinished": True, "stages_so_far": ended})
        if isinstance(event, Phase):
            now = time.perf_counter()
            name, since = started[-1]
            phases[name] = round(phases.get(name, 0.0) + now - since, 3)
            started.append((event.name, now))

    begun = time.perf_counter()
    finished = train(options, on_event)
    metrics = finished.metrics()
    stages = [{k: stage.get(k) for k in STAGE} for stage in metrics["stages"]]
    return {
        "schedule_scale": scale,
        "stages": stages,
        "training_seconds": round(sum(stage["seconds"] for stage in stages), 2),
        "all_seconds": round(time.perf_counter() - begun, 2),
        "seconds_by_phase": phases,
        "ms_per_iteration": {s["name"]: round(1e3 * s["seconds"] / s["iterations"], 3) for s in stages},
        "peak_gpu_bytes": 0 if bench.dry else int(torch.cuda.max_memory_allocated()),
        "reserved_gpu_bytes": 0 if bench.dry else int(torch.cuda.max_memory_reserved()),
    }


def table(found: dict[str, Any]) -> list[str]:
    """Return a short table."""
    lines = []
    for name, row in found.items():
        if "stages" not in row:
            lines.append(f"{name}: {row}")
            continue
        last = row["stages"][-1]
        quality = (last.get("test") or last.get("train") or {}).get("psnr")
        lines.append(
            f"{name}: {row['training_seconds']} s training, {row['ms_per_iteration']} ms, {last['splats']} splats, "
            f"PSNR {quality}, peak {row['peak_gpu_bytes'] / 1e9:.2f} GB"
        )
    return lines
