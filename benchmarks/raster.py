"""Time the CPU rasterizer alone, forward and backward of all outputs, with a probe of the machine's current speed.

    python benchmarks/raster.py [--threads 2] [--repeats 15] [--json FILE]

Prints a line per workload: minimum and median milliseconds, and the peak multiply-add and copy rates measured at the
same time. On a shared machine compare ratios and minimums, not medians.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.timing import machine, probe
from benchmarks.workload import camera, room
from gs2d.core.splats import Splats
from gs2d.kernels.library import Library, load
from gs2d.render.native_rasterizer import IMAGES, rasterize_with
from gs2d.render.types import RasterSettings

WORKLOADS = ((20_000, 400), (100_000, 400), (100_000, 800))
# Blended pairs per pixel of these workloads, counted with the reference backend.
PAIRS = {(20_000, 400): 28.7, (100_000, 400): 29.6, (100_000, 800): 28.4}
# Baseline figures: ms on two threads and pairs per pixel of a prototype in a similar room, on a machine whose peak
# multiply-add rate was 300 to 425 GFLOP/s on two threads. Compare nanoseconds per pair.
DESIGN = {(20_000, 400): (15.5, 30.4), (100_000, 400): (35.0, 40.6), (100_000, 800): (82.2, 38.9)}
# gradients that reach the rasterizer: all, or only those of L1 + SSIM
UPSTREAM = {"all": IMAGES, "color": ("color",)}


def timed(library: Library, splats: Splats, size: int, upstream: tuple[str, ...], repeats: int) -> dict[str, float]:
    """Return the milliseconds of forward and backward."""
    view, settings = camera(size), RasterSettings()
    leaves = Splats(**{name: tensor.clone().requires_grad_() for name, tensor in splats.items()})
    inputs = [tensor for _, tensor in leaves.items()]
    generator = torch.Generator().manual_seed(1)
    cotangents: list[Tensor] = []
    forward, backward = [], []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        output = rasterize_with(library, leaves, view, settings)
        middle = time.perf_counter()
        images = [getattr(output, name) for name in upstream]
        if not cotangents:
            cotangents = [torch.randn(image.shape, generator=generator) for image in images]
        between = time.perf_counter()
        torch.autograd.grad(images, inputs, cotangents)
        end = time.perf_counter()
        forward.append(1e3 * (middle - start))
        backward.append(1e3 * (end - between))
    forward, backward = forward[2:], backward[2:]
    both = [f + b for f, b in zip(forward, backward, strict=True)]
    return {
        "forward_min": round(min(forward), 2),
        "backward_min": round(min(backward), 2),
        "total_min": round(min(both), 2),
        "total_median": round(statistics.median(both), 2),
    }


def main() -> None:
    """Run the workloads, then print or write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--variant", default=None)
    parser.add_argument("--upstream", choices=tuple(UPSTREAM), default="all")
    parser.add_argument("--splats", type=int, help="number of splats, at 64 px (smoke test)")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    library = load(arguments.variant)
    torch.set_num_threads(arguments.threads)
    library.use_threads(arguments.threads)
    rows = []
    for n, size in WORKLOADS if arguments.splats is None else ((arguments.splats, 64),):
        before = probe(library)
        times = timed(library, room(n), size, UPSTREAM[arguments.upstream], arguments.repeats)
        after = probe(library)
        peak = {key: round(value, 1) for key, value in asdict(before.better(after)).items()}
        row: dict[str, object] = {
            "splats": n,
            "size": size,
            "threads": arguments.threads,
            "upstream": arguments.upstream,
            **times,
            **peak,
        }
        pairs = PAIRS.get((n, size))
        if pairs is not None:
            row["ns_per_pair"] = round(1e6 * times["total_min"] / (pairs * size * size), 2)
            if arguments.threads == 2 and arguments.upstream == "all":
                design_ms, design_pairs = DESIGN[n, size]
                row["times_design_ms"] = round(times["total_min"] / design_ms, 2)
                row["times_design_per_pair"] = round(times["total_min"] / pairs * design_pairs / design_ms, 2)
        rows.append(row)
        print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    if arguments.json is not None:
        result = {"machine": machine(), "variant": library.variant, "rows": rows}
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
