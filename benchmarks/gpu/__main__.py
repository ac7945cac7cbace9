"""Measure the CUDA backend on a GPU, in three commands (METHOD.md).

::

    python -m benchmarks.gpu correctness [--out FILE.json] [--dry-run] [--only parity memcheck ...]
    python -m benchmarks.gpu kernels     [--out FILE.json] [--dry-run] [--only 1000000 ...]
    python -m benchmarks.gpu training    [--out FILE.json] [--dry-run] --capture FOLDER ... [--schedule-scale 1.0]
                                         [--downscale 1] [--runs FOLDER]

Each writes one file, after every part of it, and prints a short table last. ``--dry-run`` goes through all of it on any
machine, at toy size, with the kernels emulated; its times mean nothing.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch loads

from benchmarks.gpu import correctness, kernels, training
from benchmarks.gpu.bench import RESULTS, Bench, clocks, commit, facts, opened, write
from gs2d.errors import Gs2dError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit status is 1 where the kernels were wrong, 2 where they cannot run."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=("correctness", "kernels", "training", "exercise"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--dry-run", action="store_true")
    parser.add_argument("--only", nargs="+", default=[], help="parts or scenes whose name contains one of these")
    parser.add_argument("--capture", type=Path, nargs="+", default=[])
    parser.add_argument("--schedule-scale", type=float, default=1.0)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--runs", type=Path, help="keep the run folders here")
    args = parser.parse_args(arguments)
    if args.command == "training" and not args.capture and not args.dry_run:
        parser.error("training needs --capture FOLDER")
    try:
        with opened(args.dry_run) as bench:
            if args.command == "exercise":
                print("not run:", *correctness.exercise(bench) or ["-"])
                return 0
            out = args.out or RESULTS / f"gpu_{args.command}.json"
            return run(args, bench, out)
    except Gs2dError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run(args: argparse.Namespace, bench: Bench, out: Path) -> int:
    """One command to its file."""
    document: dict[str, Any] = {"command": args.command, "commit": commit(), "machine": facts(bench)}

    def progress(results: dict[str, Any]) -> None:
        write(out, {**document, "results": results})

    if args.command == "correctness":
        results, module = correctness.run(bench, args.only, progress), correctness
    elif args.command == "kernels":
        results, module = kernels.run(bench, args.only, progress), kernels  # type: ignore[assignment]
    else:
        results, module = (  # type: ignore[assignment]
            training.run(bench, args.capture, args.schedule_scale, args.downscale, args.runs, progress),
            training,
        )
    if not bench.dry:
        document["clocks_after"] = clocks()
    progress(results)
    print(*module.table(results), f"written: {out}", sep="\n")
    wrong = args.command == "correctness" and correctness.wrong(results)
    return int(wrong and not bench.dry)


if __name__ == "__main__":
    sys.exit(main())
