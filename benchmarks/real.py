"""Compare an iteration on a real capture with one on the synthetic room at the same number of visible pairs.

::

    python -m benchmarks.real --out FILE.json --runs RUN [RUN ...] [--threads 1] [--rounds 12]

The splats are those of finished runs, rendered with the cameras of their captures. Runs without their folder or capture
are skipped; the file records the reason. Each run is compared with two seeded rooms of the suite: one with as many
splats as the run, one with the usual 20,000. The image size of each room is chosen to match the number of visible
(splat, pixel) pairs. Iterations of all three are timed alternately in CPU time, so that load on the machine affects all
of them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # set before torch loads, as in the command line

import torch

from benchmarks.iteration import bench_trainer
from benchmarks.stages import Passes, count_work
from benchmarks.timing import machine
from benchmarks.workload import AbsentError, Workload, places, room_workload, run_workload
from gs2d.kernels.library import Library, ready_library
from gs2d.training.trainer import Trainer

GOAL = 1.3
BENCH_SPLATS = 20_000  # splats of the common scene of the other benchmarks
SIZING_ROUNDS, CLOSE = 6, 0.01  # attempts to match the room's image size, and the accepted relative error in pairs
STAGES = ("surface", "appearance", "refine")


def visible_pairs(library: Library, workload: Workload) -> float:
    """Return the mean number of visible pairs per view."""
    counts = []
    for camera in workload.cameras:
        output = Passes(library, replace(workload, cameras=(camera,)), 3).forward()
        counts.append(count_work(library, output, len(workload.splats)).pairs)
    return statistics.mean(counts)


def matched_room(library: Library, count: int, pairs: float) -> tuple[Workload, float]:
    """Return a room of ``count`` splats on square images with about this many visible pairs, and their number."""
    side = max(16, round((pairs / 28) ** 0.5))
    room = room_workload(count, side, side)
    best, least = room, math.inf
    found = 0.0
    for _ in range(SIZING_ROUNDS):
        room = replace(room, cameras=places(side, side))
        now = visible_pairs(library, room)
        if abs(now - pairs) < least:
            best, least, found = room, abs(now - pairs), now
        if least <= CLOSE * pairs:
            break
        side = max(16, round(side * (pairs / now) ** 0.5))
    return best, found


def turns(work: dict[str, Callable[[], object]], views: int, rounds: int) -> dict[str, list[float]]:
    """Return CPU milliseconds of one call of each function, run alternately: mean over the views, per round."""
    times: dict[str, list[float]] = {name: [] for name in work}
    for round_ in range(rounds + 1):
        for name, step in work.items():
            start = time.process_time()
            for _ in range(views):
                step()
            if round_:  # the first call fills caches
                times[name].append(1e3 * (time.process_time() - start) / views)
    return times


def compare_run(library: Library, run: Path, rounds: int) -> dict[str, Any]:
    """Return one result row: iterations of all stages, of the capture and of both rooms."""
    real = run_workload(run)
    pairs = visible_pairs(library, real)
    rooms = {count: matched_room(library, count, pairs) for count in (len(real.splats), BENCH_SPLATS)}
    trainers: dict[str, Trainer] = {"capture": bench_trainer(real)}
    trainers |= {str(count): bench_trainer(room) for count, (room, _) in rooms.items()}
    stages: dict[str, Any] = {}
    for index, stage in enumerate(STAGES):
        for trainer in trainers.values():
            trainer.enter(index)
        times = turns({name: trainer.step for name, trainer in trainers.items()}, len(real.cameras), rounds)
        stages[stage] = {
            "cpu_ms": {name: round(statistics.median(found), 2) for name, found in times.items()},
            "ratio": {
                name: round(statistics.median(a / b for a, b in zip(times["capture"], found, strict=True)), 3)
                for name, found in times.items()
                if name != "capture"
            },
        }
    return {
        "workload": real.name,
        "splats": len(real.splats),
        "visible_pairs": round(pairs),
        "rooms": {
            str(count): {"side": room.cameras[0].width, "visible_pairs": round(found)}
            for count, (room, found) in rooms.items()
        },
        "stages": stages,
    }


def show(row: dict[str, Any]) -> None:
    """Print a line per stage."""
    print(f"{row['workload']}: {row['visible_pairs'] / 1e6:.2f} million visible pairs a view")
    for stage, found in row["stages"].items():
        ratios = ", ".join(f"{ratio:.2f}x the room of {name} splats" for name, ratio in found["ratio"].items())
        print(f"  {stage}: {found['cpu_ms']['capture']} ms of CPU an iteration, {ratios}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the comparison and write the file."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.real", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--runs", type=Path, nargs="+", required=True, help="folders of finished runs")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=12)
    args = parser.parse_args(arguments)
    before = torch.get_num_threads()
    document: dict[str, Any] = {"machine": machine(), "threads": args.threads, "goal": GOAL, "rows": [], "skipped": {}}
    try:
        torch.set_num_threads(args.threads)
        library = ready_library()
        for run in args.runs:
            try:
                document["rows"].append(compare_run(library, run, args.rounds))
            except AbsentError as error:
                document["skipped"][run.name] = str(error)
                print(f"skipped: {error}")
            else:
                show(document["rows"][-1])
    finally:
        torch.set_num_threads(before)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(document, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
