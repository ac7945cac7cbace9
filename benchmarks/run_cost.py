"""Measure the cost of a whole run by phase: wall seconds, CPU seconds and peak resident memory.

::

    python -m benchmarks.run_cost --out FILE.json --room [--capture FOLDER] [--schedule-scale 0.01]
                                  [--set dense_start.cell=2]
    python -m benchmarks.run_cost --out FILE.json --capture FOLDER [--downscale 2] [--schedule-scale 0.05] [--threads 2]

Both forms run one `gs2d train` in a fresh process. ``--room`` makes a capture of 292 images of 1560x1040
(``room_capture.py``; kept in ``--capture``, or in a temporary folder) and trains on it at 780x520. The file includes
the digest of ``splats.ply`` and the last scores: versions of the code that train identically have the same digest. On a
shared machine only CPU seconds and shares are meaningful.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # set before torch loads, as in the command line

from benchmarks.run_phases import RUN_PHASES
from benchmarks.sampler import CostSampler, Rule

PHASES = (
    *RUN_PHASES,
    Rule("imports", (("importlib._bootstrap>", ""),)),
)
_ADDING = (
    "add",
    "_add_chunk",
    "_blend_colors",
    "_change",
    "_view_arrays",
    "_volume_arrays",
)  # fuse a view
PARTS = (
    Rule("render", (("render/kernel_backend.py", ""), ("render/cpu_cached.py", ""))),
    Rule(
        "photographs",
        (
            ("gs2d/core/image_arrays.py", ""),
            ("data/image_files.py", ""),
            ("data/scene.py", ""),
            ("data/build.py", ""),
            ("data/undistort.py", ""),
        ),
    ),
    Rule(
        "metrics", (("evaluation/image_metrics.py", ""), ("gs2d/losses/base.py", ""), ("kernels/native_losses.py", ""))
    ),
    Rule("evidence", tuple(("meshing/evidence.py", name) for name in ("gather", "_count", "_look", "_normals"))),
    Rule("clean by evidence", (("meshing/evidence.py", ""),)),
    Rule("integrate", (*(("meshing/tsdf_volume.py", name) for name in _ADDING), ("meshing/sampling.py", ""))),
    Rule("blocks", (("meshing/tsdf_volume.py", ""),)),
    Rule("depth maps", tuple((f"meshing/{name}.py", "") for name in ("depth_maps", "fusion_bounds", "consistency"))),
    Rule("marching cubes", (("meshing/marching_cubes.py", ""),)),
)


def measure(arguments: argparse.Namespace, capture: Path, out: Path) -> dict[str, Any]:
    """Run once, sampled; the process must be fresh."""
    began = time.perf_counter(), time.process_time()
    with CostSampler(PHASES, PARTS) as costs:
        from gs2d.pipeline.prepare.options import TrainOptions
        from gs2d.pipeline.train.train_run import train

        run = train(
            TrainOptions(
                scene=capture,
                out=out,
                backend="cpu",
                recipe=arguments.recipe,
                downscale=arguments.downscale,
                schedule_scale=arguments.schedule_scale,
                overrides=tuple(arguments.set),
                threads=arguments.threads,
                overwrite=True,
            )
        )
    wall, cpu = time.perf_counter() - began[0], time.process_time() - began[1]
    stages = run.metrics()["stages"]
    total = max(sum(cost.cpu for parts in costs.values() for cost in parts.values()), 1e-9)
    rows = {
        name: {
            "cpu_seconds": round(sum(cost.cpu for cost in parts.values()), 2),
            "cpu_share": round(sum(cost.cpu for cost in parts.values()) / total, 3),
            "seconds": round(sum(cost.wall for cost in parts.values()), 2),
            "peak_rss_mb": round(max(cost.rss for cost in parts.values()) / 1e6),
            "parts_cpu_seconds": {
                part: round(cost.cpu, 2) for part, cost in sorted(parts.items(), key=lambda p: -p[1].cpu)
            },
        }
        for name, parts in costs.items()
    }
    return {
        "recipe": arguments.recipe,
        "schedule_scale": arguments.schedule_scale,
        "downscale": arguments.downscale,
        "overrides": list(arguments.set),
        "threads": arguments.threads,
        "splats": stages[-1]["splats"],
        "wall_seconds": round(wall, 1),
        "cpu_seconds": round(cpu, 1),
        "peak_rss_mb": max(row["peak_rss_mb"] for row in rows.values()),
        "phases": dict(sorted(rows.items(), key=lambda row: -row[1]["cpu_seconds"])),
        "splats_sha256": hashlib.sha256(run.file("splats.ply").read_bytes()).hexdigest(),
        "mesh_sha256": hashlib.sha256(run.file("mesh.ply").read_bytes()).hexdigest(),
        "psnr": {split: (stages[-1].get(split) or {}).get("psnr") for split in ("train", "test")},
    }


def show(result: dict[str, Any]) -> None:
    """Print the table."""
    print(f"{result['what']}: {result['cpu_seconds']} s of CPU, peak {result['peak_rss_mb']} MB resident")
    for name, row in result["phases"].items():
        parts = ", ".join(f"{part} {s}" for part, s in row["parts_cpu_seconds"].items() if s >= 0.1)
        print(f"{row['cpu_seconds']:8.2f} s {100 * row['cpu_share']:5.1f} % {row['peak_rss_mb']:6} MB  {name}: {parts}")
    print("splats.ply", result["splats_sha256"][:16], "mesh.ply", result["mesh_sha256"][:16], "PSNR", result["psnr"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the measurement and write the file."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.run_cost", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--room", action="store_true")
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--schedule-scale", type=float)
    parser.add_argument("--recipe", default="2dgs-r")
    parser.add_argument("--set", action="append", default=[], help="stage.field=value, as in `gs2d train`")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="run folder (default: a temporary one)")
    args = parser.parse_args(arguments)
    if not args.room and args.capture is None:
        parser.error("--capture FOLDER or --room expected")
    if args.schedule_scale is None:
        args.schedule_scale = 0.01 if args.room else 0.05
    with tempfile.TemporaryDirectory() as folder:
        capture = args.capture or Path(folder) / "room"
        if args.room and not (capture / "sparse" / "0" / "images.txt").exists():
            make = f"from benchmarks.room_capture import *; write_room_capture(Path({str(capture)!r}))"
            subprocess.run([sys.executable, "-c", make], check=True)  # making the capture is not a cost of the run
        result = measure(args, capture, args.keep or Path(folder) / "run")
    from benchmarks.timing import machine

    what = "room of 292 photographs" if args.room else capture.resolve().name
    document = {"machine": machine(), "what": what, **result}
    show(document)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(document, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
