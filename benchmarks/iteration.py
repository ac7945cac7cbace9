"""Time whole training iterations (render, losses, backward, statistics, Adam) in each stage of 2DGS-R.

::

    python -m benchmarks.iteration [--recipe 2dgs-r] [--splats 20000] [--size 400] [--threads 2] [--repeats 60]
        [--json FILE]

The scene is the synthetic room, rendered from four poses and then perturbed, so that there is something to learn.
Nothing is densified, so every iteration of a stage does the same work. The multiply-add probe runs before and after
each stage: on a shared machine, compare times only between equal probes. Stage 2 fills its view cache in the first
iteration; the extra time of that iteration is reported per view.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # set before torch loads, as in the command line

import numpy as np
import torch

from benchmarks.timing import Timing, machine, measure, peak_probe
from benchmarks.workload import Workload, room_workload
from gs2d.config.presets import get_recipe
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import Stage
from gs2d.core.camera import Camera
from gs2d.core.memory import hold
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene, View
from gs2d.kernels.library import Library, ready_library
from gs2d.render.api import rasterize
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer


def make_scene(splats: Splats, cameras: Sequence[Camera]) -> Scene:
    """Return a scene with renderings of the splats from these cameras."""
    views = []
    for index, camera in enumerate(cameras):
        color = rasterize(splats, camera, backend="cpu").color.clamp(0, 1)
        views.append(View.from_arrays(f"{index}.png", camera, (color * 255).round().byte().numpy()))
    bounds = np.array([[-3.0, -3.0, -3.0], [3.0, 3.0, 3.0]])
    return Scene(name="room", format="blender", train=tuple(views), test=(), points=None, extent=3.0, bounds=bounds)


def steady(stage: Stage) -> Stage:
    """Return the stage with every loss active from the first iteration and a constant number of splats."""
    densify = None if stage.densify is None else replace(stage.densify, start=10**9, stop=10**9 + 1, reset_every=0)
    losses = tuple(replace(term, start=0) for term in stage.losses)
    return replace(stage, losses=losses, densify=densify, sh_interval=0, iterations=10**6)


@dataclass(frozen=True)
class StageTime:
    """Iteration time of one stage, with the multiply-add probe and the extra time of the first iteration.

    Page faults are counted per iteration. Each page of 4 kB that the system allocates costs a microsecond or two.
    """

    timing: Timing
    fma_gflops: float
    extra_ms_of_first_by_view: float
    page_faults: float


def bench_trainer(workload: Workload, name: str = "2dgs-r") -> Trainer:
    """Return a trainer that fits renderings of the splats; every iteration of a stage does the same work."""
    hold()  # as `gs2d train` does
    scene = make_scene(workload.splats, workload.cameras)
    generator = torch.Generator().manual_seed(2)
    start = workload.splats.clone()
    start.sh0 += 0.2 * torch.randn(start.sh0.shape, generator=generator)
    recipe = get_recipe(name)
    recipe = replace(recipe, name="bench", stages=tuple(steady(stage) for stage in recipe.stages))
    return Trainer(scene, recipe, GENERIC, backend="cpu", state=TrainState(start, generator))


def iteration_times(workload: Workload, library: Library, repeats: int, name: str = "2dgs-r") -> dict[str, StageTime]:
    """Time an iteration of each stage of a recipe, on torch's number of threads."""
    trainer = bench_trainer(workload, name)
    scene, recipe = trainer.scene, trainer.recipe
    result = {}
    for index, stage in enumerate(recipe.stages):
        trainer.enter(index)
        before = peak_probe(library)
        warmup = 2 * len(scene.train) if repeats > 2 else len(scene.train)  # fill the caches with every view
        start = time.perf_counter()
        trainer.step()
        first = 1e3 * (time.perf_counter() - start)
        faults = page_faults()
        timing = measure(trainer.step, repeats=repeats, warmup=warmup)
        faults = page_faults() - faults
        extra = max(0.0, first - timing.median) / len(scene.train)
        each = faults / (repeats + warmup)
        result[stage.name] = StageTime(timing, max(before, peak_probe(library)), extra, each)
    return result


def page_faults() -> int:
    """Return the number of minor page faults of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt


def run(count: int, size: int, threads: int, repeats: int, recipe: str = "2dgs-r") -> dict[str, object]:
    """Return median and best milliseconds of an iteration of each stage."""
    torch.set_num_threads(threads)
    library = ready_library()
    times = iteration_times(room_workload(count, size, size), library, repeats, recipe)
    result = {
        name: asdict(row.timing) | {"fma_gflops": row.fma_gflops, "page_faults": round(row.page_faults, 1)}
        for name, row in times.items()
    }
    facts = {
        "recipe": recipe,
        "splats": count,
        "size": size,
        "threads": threads,
        "variant": library.variant,
        "iteration_ms": result,
    }
    filled = times.get("appearance")
    return facts if filled is None else facts | {"stage2_fill_ms_by_view": filled.extra_ms_of_first_by_view}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", default="2dgs-r")
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=60)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(arguments)
    row = run(args.splats, args.size, args.threads, args.repeats, args.recipe)
    print(json.dumps(row, indent=2))
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps({"machine": machine(), "rows": [row]}, indent=2) + "\n")


if __name__ == "__main__":
    main()
