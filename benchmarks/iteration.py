"""Times whole training iterations: render, all losses, backward, statistics, Adam, in each stage of 2DGS-R.

::

    python -m benchmarks.iteration [--splats 20000] [--size 400] [--threads 2] [--repeats 60] [--json FILE]

The splats are the synthetic room, photographed from four places and then disturbed, so that there is something to
learn; nothing is densified, so every iteration of a stage does the same work. The multiply-add probe runs before and
after each stage: on a shared machine compare times only beside equal probes.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does, before torch loads

import numpy as np
import torch

from benchmarks.timing import machine, measure, peak_probe
from benchmarks.workload import room
from gs2d.camera import Camera, look_at
from gs2d.data.scene import Scene, View
from gs2d.kernels.library import prepare
from gs2d.protocols import GENERIC
from gs2d.recipe import Recipe, Stage
from gs2d.recipes import two_dgs_r
from gs2d.render.api import rasterize
from gs2d.splats import Splats
from gs2d.train.loop import Trainer
from gs2d.train.state import TrainState

PLACES = ((0.3, -0.5, -4.0), (-0.9, -0.8, -3.8), (1.2, -0.3, -3.9), (0.0, -1.4, -4.2))


def make_scene(splats: Splats, size: int) -> Scene:
    """Photographs of the room, ``size`` x ``size``, from ``PLACES``."""
    views = []
    for index, place in enumerate(PLACES):
        up, target = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 0.2])
        camera: Camera = look_at(np.array(place), target, up, width=size, height=size, fx=0.9 * size)
        color = rasterize(splats, camera, backend="cpu").color.clamp(0, 1)
        views.append(View.from_arrays(f"{index}.png", camera, (color * 255).round().byte().numpy()))
    bounds = np.array([[-3.0, -3.0, -3.0], [3.0, 3.0, 3.0]])
    return Scene(name="room", format="blender", train=tuple(views), test=(), points=None, extent=3.0, bounds=bounds)


def steady(stage: Stage) -> Stage:
    """The stage with every loss active from the first iteration, and nothing that changes N."""
    densify = None if stage.densify is None else replace(stage.densify, start=10**9, stop=10**9 + 1, reset_every=0)
    losses = tuple(replace(term, start=0) for term in stage.losses)
    return replace(stage, losses=losses, densify=densify, sh_interval=0, iterations=10**6)


def run(count: int, size: int, threads: int, repeats: int) -> dict[str, object]:
    """Median and best milliseconds of an iteration of each stage."""
    torch.set_num_threads(threads)
    library = prepare()
    clean = room(count)
    scene = make_scene(clean, size)
    generator = torch.Generator().manual_seed(2)
    start = clean.clone()
    start.sh0 += 0.2 * torch.randn(start.sh0.shape, generator=generator)
    recipe = two_dgs_r()
    recipe = Recipe("bench", tuple(steady(stage) for stage in recipe.stages))
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", state=TrainState(start, generator))
    result: dict[str, object] = {}
    for index, stage in enumerate(recipe.stages):
        trainer.enter(index)
        before = peak_probe(library)
        timing = measure(trainer.step, repeats=repeats)
        result[stage.name] = asdict(timing) | {"fma_gflops": max(before, peak_probe(library))}
    return {"splats": count, "size": size, "threads": threads, "variant": library.variant, "iteration_ms": result}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=60)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(arguments)
    row = run(args.splats, args.size, args.threads, args.repeats)
    print(json.dumps(row, indent=2))
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps({"machine": machine(), "rows": [row]}, indent=2) + "\n")


if __name__ == "__main__":
    main()
