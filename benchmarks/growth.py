"""Measure how the steps outside an iteration scale: up to 5 million splats, and up to 4K pixels.

::

    python -m benchmarks.growth [--quick] [--only densification] [--splats 20000 ... 5000000] [--out FILE.json]

Reports the minimum CPU milliseconds of a few repetitions on one thread. ``exponent`` is the slope between the two
largest sizes in log-log space: 1 is linear, 2 quadratic. Exits with 1 if an exponent exceeds 1.35. Sorting, tree
searches and cache misses stay below that limit; quadratic algorithms do not.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # set before torch loads, as in the command line

import numpy as np
import torch

from benchmarks.fuse import orbit, sphere_map
from benchmarks.stages import densification_case, optimizer_step
from benchmarks.timing import machine
from benchmarks.workload import Workload, camera, places, room
from gs2d.core.splats import Splats
from gs2d.data.scene import PointCloud, Scene, View
from gs2d.evaluation.image_metrics import image_metrics
from gs2d.kernels.library import load
from gs2d.meshing.fusion_bounds import derive_limits, sample_depths
from gs2d.meshing.marching_cubes import keep_components
from gs2d.meshing.slabs import fused_surface
from gs2d.meshing.tsdf_volume import find_blocks
from gs2d.render.api import rasterize, splat_errors
from gs2d.training.actions.clone_in_place import CloneInPlace
from gs2d.training.actions.entry_action import StageEntry
from gs2d.training.actions.rank_by_error import RankByError
from gs2d.training.start.initialize import initial_splats
from gs2d.training.state import TrainState

SPLATS = (20_000, 100_000, 500_000, 1_000_000)
PIXELS = ((400, 300), (800, 600), (1600, 1060), (3840, 2160))
LIMIT = 1.35
Step = Callable[[], object]


def cpu_ms(make: Callable[[], Step], repeats: int) -> float:
    """Return the minimum CPU milliseconds of a step; its setup is repeated each time and not measured."""
    times = []
    for _ in range(repeats):
        step = make()
        start = time.process_time()
        step()
        times.append(1e3 * (time.process_time() - start))
    return min(times)


def small_scene(points: np.ndarray | None = None) -> Scene:
    """Return a scene of four grey views of the room."""
    image = np.full((30, 40, 3), 128, np.uint8)
    views = tuple(View.from_arrays(f"{i}.png", c, image) for i, c in enumerate(places(40, 30)))
    cloud = None if points is None else PointCloud(points, None)
    bounds = np.array([[-3.0, -3.0, -3.0], [3.0, 3.0, 3.0]])
    return Scene(name="room", format="colmap", train=views, test=(), points=cloud, extent=3.0, bounds=bounds)


def initialisation(splats: Splats) -> Step:
    """Initialise splats from points: neighbour distances by a k-d tree, and visible points per camera."""
    scene = small_scene(splats.means.double().numpy())
    generator = torch.Generator().manual_seed(0)
    return partial(initial_splats, scene, sh_degree=3, random_points=0, near=0.05, generator=generator)


def errors_of_a_view(splats: Splats) -> Step:
    """Compute the inner sum of E_i for one view of 400x400."""
    return partial(splat_errors, splats, camera(400), torch.full((400, 400, 3), 0.5), backend="cpu")


def ranking(splats: Splats) -> Step:
    """Rank E_i over four views and clone the worst 1 %."""
    generator = torch.Generator().manual_seed(0)
    state = TrainState(splats.clone(), generator)
    errors = [torch.rand(len(splats), generator=generator) for _ in range(4)]

    scene = small_scene(splats.means.double().numpy())
    entry = StageEntry("refine", scene, lambda occlusion: iter(errors))

    def step() -> None:
        RankByError("high_error").run(state, entry)
        CloneInPlace("high_error", "clones").run(state, entry)

    return step


BY_SPLATS: dict[str, Callable[[Splats], Step]] = {
    "initialisation": initialisation,
    "densification": densification_case,
    "optimizer": lambda splats: optimizer_step(Workload("", splats, ())),
    "errors of a view": errors_of_a_view,
    "ranking and clone": ranking,
}


def evaluation(width: int, height: int) -> Step:
    """Compute PSNR and SSIM of an image."""
    generator = torch.Generator().manual_seed(0)
    image, target = (torch.rand(height, width, 3, generator=generator) for _ in range(2))
    return partial(image_metrics, image, target, backend="cpu")


def rendering(width: int, height: int) -> Step:
    """Render 100 000 splats, forward only."""
    return partial(rasterize, room(100_000), camera(width, height), backend="cpu")


def meshing(width: int, height: int) -> Step:
    """Fuse four depth maps in pixel-sized voxels, run marching cubes and find components."""
    maps = [sphere_map(replace(c, height=height, cy=height / 2)) for c in orbit(4, width)]
    limits = derive_limits([sample_depths(m) for m in maps], [m.camera for m in maps], resolution=width // 4)

    def step() -> None:
        keep_components(fused_surface(maps, limits, find_blocks(maps, limits)))

    return step


BY_PIXELS: dict[str, Callable[[int, int], Step]] = {
    "evaluation": evaluation,
    "rendering": rendering,
    "meshing": meshing,
}


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Return the slope of log time over log size between the two largest sizes."""
    return math.log(times[-1] / max(times[-2], 1e-6)) / math.log(sizes[-1] / sizes[-2])


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write; return 1 if an exponent exceeds the limit."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.growth", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="tiny sizes, as a smoke test")
    parser.add_argument("--only", nargs="+", help="run only steps whose name contains one of these words")
    parser.add_argument("--splats", type=int, nargs="+", default=list(SPLATS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args(arguments)
    counts, frames, repeats = list(args.splats), list(PIXELS), args.repeats
    if args.quick:
        counts, frames, repeats = [500, 1000], [(40, 30), (80, 60)], 1
    threads = torch.get_num_threads()
    rows = {}
    try:
        torch.set_num_threads(1)
        load().use_threads(1)
        for name in (n for n in (*BY_SPLATS, *BY_PIXELS) if not args.only or any(part in n for part in args.only)):
            times: list[float] = []
            sizes = [float(n) for n in counts] if name in BY_SPLATS else [float(w * h) for w, h in frames]
            for index in range(len(sizes)):
                if name in BY_SPLATS:
                    make: Callable[[], Step] = partial(BY_SPLATS[name], room(counts[index]))
                else:
                    make = partial(BY_PIXELS[name], *frames[index])
                times.append(cpu_ms(make, repeats))
            unit = "splats" if name in BY_SPLATS else "pixels"
            rows[name] = {
                "unit": unit,
                "sizes": [int(size) for size in sizes],
                "cpu_ms": [float(f"{t:.4g}") for t in times],
                "ns_per_unit": [float(f"{1e6 * t / size:.4g}") for t, size in zip(times, sizes, strict=True)],
                "exponent": round(exponent(sizes, times), 2),
            }
            print(name, json.dumps(rows[name]), flush=True)
    finally:
        torch.set_num_threads(threads)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps({"machine": machine(), "steps": rows}, indent=1) + "\n")
    return int(not args.quick and any(row["exponent"] > LIMIT for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
