"""Measure the cost of extra channels, camera gradients and captured graphs in ``gs2d.rasterize_2dgs``.

::

    python -m benchmarks.channels [--splats 20000] [--size 400] [--repeats 10] [--backend cpu]

Runs forward and backward passes of one view of the synthetic room on one thread. Each variant is timed next to
``gs2d.rasterize`` with three plain channels in the same round. Prints the median and quartiles of the CPU time ratio.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from benchmarks.workload import camera, room
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize
from gs2d.render.tensor_api import CameraTensors, SplatTensors, rasterize_2dgs
from gs2d.render.types import PLAIN_COLORS, RasterSettings

CHANNELS = (1, 3, 4, 6, 16, 64)
Row = tuple[str, float, float, float]
"""Variant, and median, first and third quartile of its time relative to three channels of one view."""


def ways(splats: Splats, size: int, backend: str) -> dict[str, Callable[[], object]]:
    """Return forward and backward passes by name; the first is the baseline."""
    view = camera(size)
    generator = torch.Generator().manual_seed(0)
    colors = torch.rand(len(splats), max(CHANNELS), generator=generator)
    pose, K = torch.tensor(view.T_cam_world)[None], torch.tensor(view.K)[None]
    scales, opacities = splats.scales, splats.opacities
    given = (splats.means, splats.quats, scales, opacities)

    def one_view() -> None:
        parts = {name: tensor.detach().requires_grad_() for name, tensor in splats.items()}
        parts |= {"sh0": colors[:, None, :3].clone().requires_grad_(), "shN": splats.shN[:, :0].detach()}
        rasterize(Splats(**parts), view, RasterSettings(sh_degree=PLAIN_COLORS), backend=backend).color.sum().backward()

    def leaves(channels: int, cameras: bool) -> list[Tensor]:
        tensors = [tensor.detach().requires_grad_() for tensor in (*given, colors[:, :channels].clone())]
        return [*tensors, *(tensor.detach().requires_grad_(cameras) for tensor in (pose, K))]

    def loss(*tensors: Tensor) -> Tensor:
        cameras = CameraTensors(*tensors[5:], width=size, height=size)
        return rasterize_2dgs(SplatTensors(*tensors[:5]), cameras, backend=backend).colors.sum()

    def plain(channels: int, cameras: bool) -> None:
        loss(*leaves(channels, cameras)).backward()

    captured = torch.compile(loss, fullgraph=True, backend="aot_eager")
    return {
        "rasterize, 3 channels": one_view,
        **{f"{count} channels": partial(plain, count, False) for count in CHANNELS},
        "3 channels, pose and intrinsics": partial(plain, 3, True),
        "3 channels, captured graph": lambda: captured(*leaves(3, False)).backward(),
    }


def measure(splats: int, size: int, repeats: int, backend: str = "cpu") -> list[Row]:
    """Return CPU time ratios, a row per variant."""
    torch.set_num_threads(1)
    torch._dynamo.reset()
    found = ways(room(splats), size, backend)
    for work in found.values():
        work()
    seconds: dict[str, list[float]] = {name: [] for name in found}
    for _ in range(repeats):
        for name, work in found.items():
            start = time.process_time()
            work()
            seconds[name].append(time.process_time() - start)
    base = np.array(next(iter(seconds.values())))
    return [(name, *np.percentile(np.array(times) / base, (50, 25, 75)).tolist()) for name, times in seconds.items()]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--size", type=int, default=400, help="image width and height, px")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--backend", default="cpu", help="cpu or reference")
    options = parser.parse_args(arguments)
    for name, median, low, high in measure(options.splats, options.size, options.repeats, options.backend):
        print(f"{name:34} {median:6.2f}  ({low:.2f} to {high:.2f})")


if __name__ == "__main__":
    main()
