"""Run the benchmark suite or compare two results.

::

    python -m benchmarks --out FILE.json [--quick] [--threads 2] [--only 20k 100k-800] [--variant v3]
                         [--splats RUN_OR_PLY --capture FOLDER [--downscale N]] [--runs RUN [RUN ...]]
    python -m benchmarks compare A.json B.json

The first form times every workload stage by stage. ``--quick`` is a smoke test that takes a few seconds. ``--splats``
adds a workload of trained splats, viewed by the cameras of their capture. ``--runs`` adds the splats of finished runs;
captures are located through the run folders, and missing ones are skipped with a message. The second form exits with 1
if B is slower than A by more than noise (rule: benchmarks/compare.py), and with 2 if the files cannot be compared.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # set before torch loads, as in the command line

from benchmarks.compare import NotComparable, compare
from benchmarks.suite import run_suite
from benchmarks.workload import (
    FULL,
    QUICK,
    AbsentError,
    Workload,
    name_of,
    room_workload,
    run_workload,
    trained_workload,
)


def report(path: Path, name: str, document: dict[str, Any]) -> None:
    """Print a short summary of a finished workload; the result file has every figure."""
    result = document["workloads"][name]
    ms, iteration = result["best_ms"], result["iteration_ms"]
    executed, useful = result["fma_fraction_executed"], result["fma_fraction"]
    print(
        f"{name}: best forward {ms['raster_forward']} + backward {ms['raster_backward']} ms, of peak FMA "
        f"{executed['forward']:.3f} / {executed['backward']:.3f} executed ({useful['forward']:.3f} / "
        f"{useful['backward']:.3f} useful), iteration "
        f"{' / '.join(str(iteration[f'stage{i}']) for i in (1, 2, 3))} ms, "
        f"{result['bytes_per_splat']} bytes a splat, probe {result['probe']['fma_gflops']} GFLOP/s",
        flush=True,
    )
    path.write_text(json.dumps(document, indent=1) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the suite or compare two results; return the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] == ["compare"]:
        return compare_files(words[1:])
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=6.0, help="minimum time per group of steps")
    parser.add_argument("--only", nargs="+", help="run only workloads whose name contains one of these words")
    parser.add_argument(
        "--crossing", action="store_true", help="add 0.3 %% more splats that cross the camera plane and are not visible"
    )
    parser.add_argument("--variant", help="instruction set: v4, v3 or portable (default: best supported)")
    parser.add_argument("--splats", type=Path, help="run folder or PLY of trained splats")
    parser.add_argument("--capture", type=Path, help="capture that the splats were trained on")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--runs", type=Path, nargs="+", default=[], help="folders of finished runs")
    args = parser.parse_args(words)
    if (args.splats is None) != (args.capture is None):
        parser.error("--splats and --capture belong together")
    if args.variant:
        os.environ["GS2D_CPU_VARIANT"] = args.variant  # losses and training read the number of threads from torch
    sizes = [s for s in (QUICK if args.quick else FULL) if not args.only or any(o in name_of(*s) for o in args.only)]
    workloads = [partial(room_workload, *size, crossing=args.crossing) for size in sizes]
    if args.splats is not None:
        workloads.append(partial(trained_workload, args.splats, args.capture, args.downscale))
    workloads += runs_there(args.runs)
    if not workloads:
        there = ", ".join(name_of(*size) for size in (QUICK if args.quick else FULL))
        parser.error(f"no workload is called {' or '.join(args.only)}; there are {there}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    run_suite(
        workloads,
        threads=args.threads,
        seconds=0.05 if args.quick else args.seconds,
        least=2 if args.quick else 5,
        on_result=partial(report, args.out),
    )
    return 0


def runs_there(runs: Sequence[Path]) -> list[Callable[[], Workload]]:
    """Return the workloads of the runs that exist on this machine; print the others with the reason."""
    found: list[Callable[[], Workload]] = []
    for run in runs:
        try:
            run_workload(run)
        except AbsentError as error:
            print(f"skipped: {error}", file=sys.stderr)
        else:
            found.append(partial(run_workload, run))
    return found


def compare_files(words: Sequence[str]) -> int:
    """Compare two result files: return 0 without a regression, 1 with one, 2 if they are not comparable."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks compare")
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    args = parser.parse_args(words)
    try:
        changes = compare(json.loads(args.before.read_text()), json.loads(args.after.read_text()))
    except NotComparable as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for change in changes:
        print(change)
    return int(any(change.regressed for change in changes))


if __name__ == "__main__":
    sys.exit(main())
