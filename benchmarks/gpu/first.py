"""Part 0, a three-minute check: are the kernels correct, and where is the time spent.

The parts run in order of importance: missing requirements of the machine; the name of the first failing kernel; parity
of images and gradients with the reference; milliseconds of an iteration with its host time and GPU utilisation; and a
trace.
"""

from __future__ import annotations

import gzip
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.gpu import correctness, host
from benchmarks.gpu.bench import ROOT, Bench, rounded, run_program
from benchmarks.gpu.kernels import bench_trainer
from benchmarks.gpu.scenes import FIRST, TOY, gpu_scene, scene_name
from gs2d.errors import BackendError
from gs2d.kernels.cuda import diagnose

ITERATIONS, WARMUP, TRACED = 200, 16, 5


def run(bench: Bench, only: list[str], progress: Any) -> dict[str, Any]:
    """Run all parts; ``progress`` gets the results after each."""
    sizes = TOY if bench.dry else FIRST
    parts: dict[str, Any] = {
        "machine": machine,
        "exercise": lambda: exercise(bench),
        "parity": lambda: correctness.parity(bench, 1 if bench.dry else 10),
        "host": lambda: host.host_cost(5 if bench.dry else 200, stages=1 if bench.dry else 4),
        **{scene_name(*size, "A"): lambda size=size: speed(bench, *size) for size in sizes},
    }
    return bench.attempt_all(parts, only, progress)


def machine() -> dict[str, Any]:
    """Report the backend's requirements on this machine, without importing the command line or its packages."""
    found: dict[str, Any] = {"missing": None}
    try:
        found["details"] = diagnose.machine()
    except BackendError as error:
        found["missing"] = str(error)
    try:
        done = subprocess.run(["nvidia-smi"], capture_output=True, text=True, timeout=20, check=False)
        found["nvidia_smi"] = done.stdout.splitlines()
    except (OSError, subprocess.SubprocessError) as error:
        found["nvidia_smi"] = str(error)
    return found


def exercise(bench: Bench) -> dict[str, Any]:
    """Run every kernel once and wait for each, so that an error names the kernel that caused it."""
    command = [sys.executable, "-m", "benchmarks.gpu", "exercise", *(["--dry-run"] if bench.dry else [])]
    environment = {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", "CUDA_LAUNCH_BLOCKING": "1"}
    done = run_program(command, seconds=bench.seconds_left(200 if bench.dry else 60), environment=environment)
    return {"exit": done.exit, "clean": done.exit == 0, "last_lines": done.lines[-5:]}


def speed(bench: Bench, count: int, width: int, height: int) -> dict[str, Any]:
    """Measure by stage: milliseconds of an iteration, host time, GPU utilisation, and a trace."""
    scene = gpu_scene(count, width, height, "A", bench.device)
    trainer = bench_trainer(bench, scene)
    found: dict[str, Any] = {}
    for index, stage in enumerate(trainer.recipe.stages):
        trainer.enter(index)
        for _ in range(1 if bench.dry else WARMUP):
            trainer.step()
        found[stage.name] = {
            **timed(bench, trainer, 2 if bench.dry else ITERATIONS),
            **traced(bench, trainer, f"{scene.name}-{stage.name}"),
        }
    return found


def timed(bench: Bench, trainer: Any, repeats: int) -> dict[str, float]:
    """Time all iterations together, and the calls alone; each call waits for the previous number of pairs."""
    bench.wait()
    begun, cpu = time.perf_counter(), time.thread_time()
    for _ in range(repeats):
        trainer.step()
    queued = time.perf_counter() - begun
    worked = time.thread_time() - cpu
    bench.wait()
    every = {"iteration": time.perf_counter() - begun, "host_calls": queued, "host_processor": worked}
    return rounded({f"{name}_ms": 1e3 * seconds / repeats for name, seconds in every.items()})


def traced(bench: Bench, trainer: Any, name: str) -> dict[str, Any]:
    """Profile five iterations with torch; return the GPU-busy share of time, and write the gzipped trace."""
    activities = [torch.profiler.ProfilerActivity.CPU]
    activities += [] if bench.dry else [torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        for _ in range(1 if bench.dry else TRACED):
            trainer.step()
        bench.wait()
    spans = [
        (event.time_range.start, event.time_range.end)
        for event in profile.events() or ()
        if event.device_type == torch.autograd.DeviceType.CUDA
    ]
    folder = Path(os.environ.get("GS2D_WORK", "."))
    if "GS2D_WORK" in os.environ:
        plain = folder / f"trace-{name}.json"
        profile.export_chrome_trace(str(plain))
        with plain.open("rb") as source, gzip.open(f"{plain}.gz", "wb", compresslevel=6) as packed:
            shutil.copyfileobj(source, packed)
        plain.unlink()
    return {"gpu_kernels": len(spans) / (1 if bench.dry else TRACED), "gpu_busy_fraction": busy_fraction(spans)}


def busy_fraction(spans: list[tuple[float, float]]) -> float | None:
    """Return the share of the total time range covered by at least one interval; None without intervals."""
    if not spans:
        return None
    covered, reached = 0.0, min(start for start, _ in spans)
    first = reached
    for start, end in sorted(spans):
        covered += max(0.0, end - max(start, reached))
        reached = max(reached, end)
    return round(covered / max(reached - first, 1e-9), 4)


def wrong(found: dict[str, Any]) -> bool:
    """Return True if a kernel failed or a part could not run."""
    return correctness.wrong({name: part for name, part in found.items() if isinstance(part, dict)})


def table(found: dict[str, Any]) -> list[str]:
    """Return a short table."""
    lines = [f"missing: {found.get('machine', {}).get('missing')}", f"exercise: {found.get('exercise')}"]
    images = found.get("parity", {}).get("images", {})
    lines += [f"{name}: median {row['median']:.1e}, flipped {row['flipped']:.1e}" for name, row in images.items()]
    for name, part in found.items():
        for stage, row in part.items():
            if isinstance(row, dict) and "iteration_ms" in row:
                lines.append(f"{name} {stage}: {row}")
    return lines
