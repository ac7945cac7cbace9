"""Measure the CUDA backend on a GPU (METHOD.md); ``host`` needs no GPU.

::

    python -m benchmarks.gpu first       [--out FILE.json] [--dry-run]
    python -m benchmarks.gpu host        [--out FILE.json]
    python -m benchmarks.gpu correctness [--out FILE.json] [--dry-run] [--only parity memcheck ...]
    python -m benchmarks.gpu kernels     [--out FILE.json] [--dry-run] [--only 1000000 ...]
    python -m benchmarks.gpu real        [--out FILE.json] [--dry-run] --capture FOLDER ... [--recipe best]
                                         [--schedule-scale 1.0] [--downscale 1]
    python -m benchmarks.gpu peers       [--out FILE.json] [--dry-run] --capture FOLDER [--only gsplat ...]
                                         [--trainer 'NAME=COMMAND {capture} {out}' ...] [--schedule-scale 1.0]
                                         [--downscale 1] [--runs FOLDER]
    python -m benchmarks.gpu training    [--out FILE.json] [--dry-run] --capture FOLDER ... [--schedule-scale 1.0]
                                         [--downscale 1] [--runs FOLDER] [--synthetic]

Each command writes one file, updated after every part, and prints a short table at the end. ``--minutes M`` starts no
part after M minutes, for machines that are lent by the minute. ``--dry-run`` runs everything on any machine at toy size
with emulated kernels; its times are meaningless.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchmarks.gpu.bench import Bench

NEEDED = ("torch", "numpy", "scipy", "PIL")
COMMANDS = ("first", "correctness", "kernels", "training", "real", "peers", "exercise", "host")


def unfit() -> str:
    """Return why this Python cannot run the benchmarks, or ""."""
    version: tuple[int, ...] = tuple(sys.version_info[:2])
    here = ".".join(map(str, version))
    if version < (3, 11):
        return f"Python 3.11 or newer is needed, {sys.executable} is {here}; use the .venv of `make install`"
    lacking = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if lacking:
        return f"{sys.executable} (Python {here}) lacks {', '.join(lacking)}; use the .venv of `make install`"
    if importlib.util.find_spec("gs2d") is None:
        return f"{sys.executable} does not find gs2d; set PYTHONPATH=src in the checkout, or use its .venv"
    return ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit status is 1 if a check failed and 2 if the command cannot run."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=COMMANDS)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--dry-run", action="store_true")
    parser.add_argument(
        "--only", nargs="+", default=[], help="run only parts or scenes whose name contains one of these words"
    )
    parser.add_argument("--capture", type=Path, nargs="*", default=[])
    parser.add_argument(
        "--synthetic", action="store_true", help="also train on a synthetic capture made by this command"
    )
    parser.add_argument("--recipe", default="best", help="recipe of the command real")
    parser.add_argument("--schedule-scale", type=float, default=1.0)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--runs", type=Path, help="keep the run folders here; of peers, the splats")
    parser.add_argument(
        "--trainer", nargs="+", default=[], metavar="NAME=COMMAND", help="trainings of the command peers"
    )
    parser.add_argument("--one", help=argparse.SUPPRESS)  # a part of the command peers, in this process
    parser.add_argument("--minutes", type=float, help="start no part after this many minutes (peers: 25)")
    args = parser.parse_args(arguments)
    if args.minutes is None:
        args.minutes = 25.0 if args.command == "peers" else math.inf
    if args.command == "peers" and not args.dry_run and len(args.capture) != 1:
        parser.error("peers needs --capture FOLDER, one")
    if any("=" not in trainer for trainer in args.trainer):
        parser.error("--trainer needs NAME=COMMAND")
    if args.command == "training" and not args.capture and not args.dry_run and not args.synthetic:
        parser.error("training needs --capture FOLDER or --synthetic")
    if args.command == "real" and not args.capture:
        parser.error("real needs --capture FOLDER")
    reason = unfit()
    if reason:
        print(f"error: {reason}", file=sys.stderr)
        return 2
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # set before torch loads, as in the command line
    from benchmarks.gpu import correctness
    from benchmarks.gpu.bench import RESULTS, opened
    from gs2d.errors import Gs2dError

    if args.command == "host":
        return host_alone(args.out or RESULTS / "gpu_host.json")
    try:
        with opened(args.dry_run, args.minutes) as bench:
            if args.command == "exercise":
                print("not run:", *correctness.exercise(bench) or ["-"])
                return 0
            out = args.out or RESULTS / f"gpu_{args.command}.json"
            return run(args, bench, out)
    except Gs2dError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def host_alone(out: Path) -> int:
    """Measure the host cost of an iteration for each execution mode, and the compiled kernels, on any machine."""
    from benchmarks.gpu import host
    from benchmarks.gpu.bench import commit, write
    from benchmarks.timing import machine

    found = {way: host.host_cost(way=way) for way in host.WAYS}
    made = host.machine_code()
    write(out, {"command": "host", "commit": commit(), "machine": machine(), "results": found, "machine_code": made})
    for way, stages in found.items():
        print(f"{way}:", *host.table(stages), sep="\n  ")
    print("sm_90:", *(f"{name}: {row}" for name, row in made.items()), f"written: {out}", sep="\n  ")
    return 0


def run(args: argparse.Namespace, bench: Bench, out: Path) -> int:
    """Run one command and write its result file."""
    from benchmarks.gpu import correctness, first, kernels
    from benchmarks.gpu.bench import clocks, commit, facts, write

    document: dict[str, Any] = {"command": args.command, "commit": commit(), "machine": facts(bench)}

    def progress(results: dict[str, Any]) -> None:
        write(out, {**document, "results": results})

    earlier: dict[str, Any] = {}
    if args.command == "peers" and args.one is None:
        document["capture"] = [str(each) for each in args.capture]
        written = json.loads(out.read_text()) if out.exists() else {}
        earlier = written.get("results", {}) if written.get("capture") == document["capture"] else {}
    progress(earlier)  # detect an unwritable path before anything slow runs
    module: ModuleType
    if args.command == "first":
        results, module = first.run(bench, args.only, progress), first
    elif args.command == "correctness":
        results, module = correctness.run(bench, args.only, progress), correctness
    elif args.command == "kernels":
        results, module = kernels.run(bench, args.only, progress), kernels
    elif args.command == "real":
        from benchmarks.gpu import real

        given = (args.capture, args.recipe, args.schedule_scale, args.downscale)
        results, module = real.run(bench, *given, progress), real
    elif args.command == "peers":
        from benchmarks.gpu import beside

        results, module = peers(args, bench, earlier, progress), beside
    else:
        from benchmarks.gpu import training  # imported here: only this command needs the pipeline

        captures = (args.capture, args.schedule_scale, args.downscale, args.runs)
        results, module = training.run(bench, *captures, progress, synthetic=args.synthetic), training
    if not bench.dry:
        document["clocks_after"] = clocks()
    progress(results)
    print(*module.table(results), f"written: {out}", sep="\n")
    wrong = (args.command == "correctness" and correctness.wrong(results)) or (
        args.command == "first" and first.wrong(results)
    )
    return int(wrong and not bench.dry)


def peers(args: argparse.Namespace, bench: Bench, earlier: dict[str, Any], progress: Any) -> dict[str, Any]:
    """Measure all rasterizers on a capture, or with ``--one`` one of them in this process."""
    from benchmarks.gpu import beside
    from benchmarks.gpu.training import toy_capture

    with tempfile.TemporaryDirectory() as temporary:
        folder = args.runs or Path(temporary) / "splats"
        capture = args.capture[0] if args.capture else toy_capture(Path(temporary))
        sizes = 0.0005 if bench.dry else args.schedule_scale, args.downscale
        if args.one is not None:
            return beside.measure(bench, args.one, capture, sizes, folder, progress)
        return beside.run(bench, capture, sizes, folder, args.only, args.trainer, earlier, progress)


if __name__ == "__main__":
    sys.exit(main())
