"""Time the multi-view losses added to an iteration: rendering the neighbour, the losses in torch, and native.

::

    python -m benchmarks.multiview [--splats 20000] [--size 400] [--threads 1] [--repeats 40] [--json FILE]

Uses the room of ``benchmarks.iteration`` with 2048 patches of 7 x 7 and both losses with gradients. Reports CPU
milliseconds of this process, so other load on the machine has little effect. All variants run alternately in one
process, so that ratios are reliable.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # set before torch loads, as in the command line

import torch
from torch import Tensor

from benchmarks.iteration import bench_trainer
from benchmarks.timing import machine
from benchmarks.workload import room_workload
from gs2d.config.protocols import GENERIC
from gs2d.kernels.library import ready_library
from gs2d.kernels.native_multiview import compare_views
from gs2d.losses.view_pair import ViewPair, geometric, photometric
from gs2d.render.api import rasterize
from gs2d.training.trainer import Trainer

RECIPE = "2dgs-multiview"


def losses(pair: ViewPair, *, native: bool) -> tuple[Tensor, ...]:
    """Return the gradients of both losses to fresh leaves."""
    leaves = pair.depth.detach().requires_grad_(), pair.normal.detach().requires_grad_()
    views = replace(pair, depth=leaves[0], normal=leaves[1])
    values = views.compared(compare_views) if native else (photometric(views), geometric(views))
    return torch.autograd.grad(0.3 * values[0] + 0.02 * values[1], leaves)


def in_turns(works: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Return the median CPU milliseconds of each function, run alternately."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(repeats + 3):
        for name, work in works.items():
            start = time.process_time()
            work()
            if turn >= 3:
                times[name].append(1e3 * (time.process_time() - start))
    return {name: statistics.median(found) for name, found in times.items()}


def make_pair(trainer: Trainer) -> ViewPair:
    """Return the first view of a trainer and the neighbour of the first iteration."""
    objective = trainer._whole
    state, stage = trainer.state, trainer.recipe.stages[0]
    neighbour = objective.neighbour_of(state, stage, 1, 0, state.splats)
    assert neighbour is not None
    with torch.no_grad():
        output = rasterize(state.splats, trainer.scene.train[0].camera, objective.settings(stage, 1), backend="cpu")
    hit = (output.alpha > neighbour.settings.opacity) & (output.depth_mean > 0)
    candidates = hit & neighbour.reference.textured
    camera = trainer.scene.train[0].camera
    return ViewPair(output.depth_mean, output.normal, candidates, camera, neighbour)


def run(count: int, size: int, threads: int, repeats: int) -> dict[str, object]:
    """Return the milliseconds of each part, and their fractions of an iteration without them."""
    torch.set_num_threads(threads)
    workload = room_workload(count, size, size)
    plain, compared = (bench_trainer(workload, name) for name in ("2dgs", RECIPE))
    settings = compared.recipe.multiview
    assert settings is not None
    recipe = replace(compared.recipe, multiview=replace(settings, depth_downscale=2))
    coarse = Trainer(compared.scene, recipe, GENERIC, backend="cpu", state=bench_trainer(workload, RECIPE).state)
    for trainer in (plain, compared, coarse):
        trainer.enter(0)
    pair = make_pair(compared)
    objective, state, stage = compared._whole, compared.state, compared.recipe.stages[0]
    works: dict[str, Callable[[], object]] = {
        "iteration without": plain.step,
        "iteration with": compared.step,
        "iteration with, depth_downscale 2": coarse.step,
        "render of the neighbour": lambda: objective.neighbour_of(state, stage, 1, 0, state.splats),
        "render of the neighbour, depth_downscale 2": lambda: coarse._whole.neighbour_of(
            state, stage, 1, 0, state.splats
        ),
        "losses in torch": lambda: losses(pair, native=False),
        "losses, native": lambda: losses(pair, native=True),
    }
    times = in_turns(works, repeats)
    base = times["iteration without"]
    return {
        "splats": count,
        "size": size,
        "threads": threads,
        "variant": ready_library().variant,
        "patches": len(pair.neighbour.draws),
        "cpu_ms": {name: round(value, 3) for name, value in times.items()},
        "of_an_iteration_without": {name: round(value / base, 4) for name, value in times.items()},
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=40)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(arguments)
    row = run(args.splats, args.size, args.threads, args.repeats)
    print(json.dumps(row, indent=2))
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps({"machine": machine(), "rows": [row]}, indent=2) + "\n")


if __name__ == "__main__":
    main()
