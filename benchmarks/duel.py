"""Time training iterations of two source trees alternately, so that machine load affects both equally.

::

    python -m benchmarks.duel BEFORE AFTER [--splats 20000] [--size 400] [--threads 2] [--stage 0] [--rounds 40]

BEFORE and AFTER are checkouts with built kernels (``scripts/build_kernels.sh``). Each runs its own code in its own
process, on the workload of ``benchmarks.iteration``. The processes take turns of a few iterations; one waits while the
other works. The first iteration of each turn is not counted, because the caches hold the other process's data.
``--splats 200 --size 16`` measures the overhead outside the kernels.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path


def serve(splats: int, size: int, threads: int, stage: int) -> None:
    """Read iteration counts from stdin and write the measured seconds to stdout."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # set before torch loads, as in the command line
    import torch

    from benchmarks.iteration import make_scene, steady
    from benchmarks.workload import room_workload
    from gs2d.config.presets import two_dgs_r
    from gs2d.config.protocols import GENERIC
    from gs2d.config.recipe import Recipe
    from gs2d.training.state import TrainState
    from gs2d.training.trainer import Trainer

    torch.set_num_threads(threads)
    workload = room_workload(splats, size, size)
    generator = torch.Generator().manual_seed(2)
    start = workload.splats.clone()
    start.sh0 += 0.2 * torch.randn(start.sh0.shape, generator=generator)
    recipe = Recipe("bench", tuple(steady(stage) for stage in two_dgs_r().stages))
    scene, state = make_scene(workload.splats, workload.cameras), TrainState(start, generator)
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", state=state)
    for index in range(stage + 1):  # a stage needs the row groups of earlier stages
        trainer.enter(index)
    for _ in range(2 * len(scene.train)):  # render every view twice to fill the caches
        trainer.step()
    print("ready", flush=True)
    for line in sys.stdin:
        seconds = []
        for _ in range(int(line)):
            begin = time.perf_counter()
            trainer.step()
            seconds.append(time.perf_counter() - begin)
        print(*seconds, flush=True)


def start_side(checkout: Path, arguments: Sequence[str]) -> subprocess.Popen[str]:
    """Start a process that serves iterations of a checkout, with that checkout's benchmarks if they include this
    module.
    """
    here = Path(__file__).resolve().parents[1]
    paths = [checkout / "src", checkout, here]  # older checkouts lack this module and use the workload of `here`
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(str(path.resolve()) for path in paths)}
    command = [sys.executable, str(Path(__file__).resolve()), "--serve", *arguments]
    side = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=checkout
    )
    assert side.stdout is not None
    if side.stdout.readline().strip() != "ready":
        raise SystemExit(f"{checkout} could not train; build its kernels with scripts/build_kernels.sh")
    return side


def take_turns(sides: Sequence[subprocess.Popen[str]], rounds: int, each: int) -> list[list[float]]:
    """Return the milliseconds of each side's iterations."""
    times: list[list[float]] = [[] for _ in sides]
    for _ in range(rounds):
        for side, found in zip(sides, times, strict=True):
            assert side.stdin is not None
            assert side.stdout is not None
            side.stdin.write(f"{each + 1}\n")
            side.stdin.flush()
            found.extend(1e3 * float(second) for second in side.stdout.readline().split()[1:])
    return times


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", type=Path, nargs="*", metavar="BEFORE AFTER")
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--stage", type=int, default=0, choices=(0, 1, 2), help="surface, appearance or refine")
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--each", type=int, default=8, help="iterations per turn")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.serve:
        return serve(args.splats, args.size, args.threads, args.stage)
    if len(args.checkouts) != 2:
        parser.error(f"two checkouts were expected, BEFORE and AFTER, got {len(args.checkouts)}")
    given = [f"--{name}={getattr(args, name)}" for name in ("splats", "size", "threads", "stage")]
    sides = [start_side(checkout, given) for checkout in args.checkouts]
    times = take_turns(sides, args.rounds, args.each)
    for side in sides:
        side.communicate()
    rows = []
    for checkout, found in zip(args.checkouts, times, strict=True):
        low, median, _ = statistics.quantiles(found, n=4)
        rows.append({"checkout": checkout.name, "best": min(found), "quarter": low, "median": median})
        print(f"{checkout.name}: best {min(found):.2f}, a quarter below {low:.2f}, median {median:.2f} ms")
    ratios = {name: float(rows[1][name]) / float(rows[0][name]) for name in ("best", "quarter", "median")}
    print("after / before: " + ", ".join(f"{name} {ratio:.3f}" for name, ratio in ratios.items()))
    if args.json is not None:
        from benchmarks.timing import machine

        names = ("splats", "size", "threads", "stage", "rounds", "each")
        facts: dict[str, object] = {name: getattr(args, name) for name in names}
        facts |= {"machine": machine(), "rows": rows, "after_over_before": ratios}
        args.json.write_text(json.dumps(facts, indent=2) + "\n")


if __name__ == "__main__":
    main()
