"""Profile a whole run by phase (reading, stages, scoring, meshing, report) and by part within each phase.

::

    python -m benchmarks.profile_run --out FILE.json --demo [--schedule-scale 0.1] [--threads 2]
    python -m benchmarks.profile_run --out FILE.json --capture FOLDER [--downscale 2] [--schedule-scale 0.03]
                                     [--keep RUN]

The first form profiles `gs2d demo`, the second `gs2d train FOLDER`. The file includes the digest of ``splats.ply``:
versions of the code that train identically have the same digest.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # set before torch loads, as in the command line

import torch

from benchmarks.run_phases import LOOP, RUN_PHASES
from benchmarks.sampler import Rule, Sampler, Seconds
from benchmarks.timing import machine, peak_probe
from gs2d.contrib.demo.demo_command import DemoOptions
from gs2d.contrib.demo.run_demo import SCHEDULE_SCALE, demo
from gs2d.kernels.library import load
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.train_run import train

PHASES = (
    *RUN_PHASES,
    Rule("photograph the demo scene", (("demo/demo_capture.py", "write_demo_capture"),)),
    Rule("evaluate", (("pipeline/finish/evaluate.py", "evaluate_run"),)),
)
PARTS = (
    Rule("rasterizer", (("render/kernel_backend.py", ""), ("render/cpu_cached.py", ""))),
    Rule(
        "losses and metrics",
        (("gs2d/losses/base.py", ""), ("kernels/native_losses.py", ""), ("evaluation/image_metrics.py", "")),
    ),
    Rule("Adam", (("training/optimizer.py", ""),)),
    Rule("densification", (("training/densify/gradient.py", "densify_and_prune"),)),
    Rule("densification statistics", (("training/densify/gradient.py", "_add"),)),
    Rule("checks for NaN", (("training/objective.py", "first_not_finite"),)),
    Rule(
        "photographs",
        (
            ("gs2d/core/image_arrays.py", ""),
            ("data/image_files.py", ""),
            ("data/scene.py", ""),
            ("training/targets.py", ""),
        ),
    ),
    Rule("fusion", (("meshing/tsdf_volume.py", ""), ("meshing/sampling.py", ""))),
    Rule("depth maps", tuple((f"meshing/{name}.py", "") for name in ("depth_maps", "fusion_bounds", "consistency"))),
    Rule("marching cubes", (("meshing/marching_cubes.py", ""),)),
    Rule(
        "surface score",
        (("lab/surface_score.py", ""), ("lab/visibility.py", "")),
    ),
    Rule("neighbours", (("gs2d/core/transforms.py", "nearest_distances"),)),
    Rule("imports", (("importlib._bootstrap>", ""),)),
    Rule(
        "log and progress",
        (("pipeline/train/run_logger.py", ""), ("io/run_dir.py", ""), ("core/json_files.py", ""), (LOOP, "_progress")),
    ),
)


def table(seconds: Seconds) -> dict[str, Any]:
    """Return seconds by phase and part, largest first, and the rasterizer's share of the total."""
    total = sum(sum(parts.values()) for parts in seconds.phases.values())
    rows = sorted(seconds.phases.items(), key=lambda row: -sum(row[1].values()))
    raster = sum(parts.get("rasterizer", 0.0) for parts in seconds.phases.values())
    return {
        "seconds": round(total, 2),
        "rasterizer_share": round(raster / max(total, 1e-9), 3),
        "phases": {
            name: {
                "seconds": round(sum(parts.values()), 2),
                "parts": {part: round(s, 2) for part, s in sorted(parts.items(), key=lambda p: -p[1])},
            }
            for name, parts in rows
        },
        "elsewhere": {k: round(s, 2) for k, s in sorted(seconds.deepest.items(), key=lambda p: -p[1])[:12]},
    }


def profile(arguments: argparse.Namespace, out: Path) -> dict[str, Any]:
    """Sample one run into ``out``."""
    library = load()
    probe = peak_probe(library)
    began = time.perf_counter(), time.process_time()
    with Sampler(PHASES, PARTS) as seconds:
        if arguments.demo:
            scale = SCHEDULE_SCALE if arguments.schedule_scale is None else arguments.schedule_scale
            run = demo(DemoOptions(out=out, backend="cpu", schedule_scale=scale, threads=arguments.threads))
        else:
            scale = 0.03 if arguments.schedule_scale is None else arguments.schedule_scale
            run = train(
                TrainOptions(
                    scene=arguments.capture,
                    out=out,
                    backend="cpu",
                    downscale=arguments.downscale,
                    schedule_scale=scale,
                    threads=arguments.threads,
                    overwrite=True,
                )
            )
    stages = run.metrics()["stages"]
    return {
        "what": "demo" if arguments.demo else arguments.capture.resolve().name,
        "schedule_scale": scale,
        "downscale": arguments.downscale,
        "splats": stages[-1]["splats"],
        "stage_seconds": {stage["name"]: stage["seconds"] for stage in stages},
        "splats_sha256": hashlib.sha256(run.file("splats.ply").read_bytes()).hexdigest(),
        "wall_seconds": round(time.perf_counter() - began[0], 2),
        "cpu_seconds": round(time.process_time() - began[1], 2),
        "fma_gflops": round(max(probe, peak_probe(library)), 1),
        **table(seconds),
    }


def show(result: dict[str, Any]) -> None:
    """Print the table."""
    print(f"{result['what']}: {result['wall_seconds']} s, rasterizer {100 * result['rasterizer_share']:.0f} %")
    for name, phase in result["phases"].items():
        parts = ", ".join(f"{part} {s}" for part, s in phase["parts"].items() if s >= 0.1)
        print(f"{phase['seconds']:8.2f} s  {name}: {parts}")
    print("elsewhere:", ", ".join(f"{name} {s}" for name, s in result["elsewhere"].items() if s >= 0.1))
    print("splats.ply", result["splats_sha256"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the profile and write the file."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.profile_run",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--demo", action="store_true")
    what.add_argument("--capture", type=Path)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--schedule-scale", type=float)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="run folder (default: a temporary one)")
    args = parser.parse_args(arguments)
    before = torch.get_num_threads()
    try:
        with tempfile.TemporaryDirectory() as folder:
            result = profile(args, args.keep or Path(folder) / "run")
    finally:
        torch.set_num_threads(before)
    show(result)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"machine": machine(), **result}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
