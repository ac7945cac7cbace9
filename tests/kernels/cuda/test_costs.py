"""Limits on the work of an iteration for host and device, and on the machine code of kernels; no GPU needed.

They are counts, not times, so they are the same on every machine. ``python -m benchmarks.gpu host`` and
``python -m benchmarks.gpu.sass`` print them together with times.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

import pytest
import torch
from benchmarks.gpu.host import host_cost

from emulate import Emulator
from gs2d.kernels.cuda.kernel_arguments import arguments_of
from gs2d.render import cuda_works

# gs2d launches, device launches, torch operations, allocations. More than 256 tiles per image add a launch. The torch
# operation shuffles the views on the host, once per epoch. One launch is for pieces of long tile lists.
LIMITS = {
    "graph": {
        "surface": (21, 21, 1, 0),
        "appearance": (20, 20, 1, 0),
        "refine": (21, 21, 1, 0),
        "best": (22, 22, 1, 0),
    },
    "launches": {
        "surface": (21, 21, 1, 0),
        "appearance": (20, 20, 1, 0),
        "refine": (21, 21, 1, 0),
        "best": (22, 22, 1, 0),
    },
    "torch": {
        "surface": (15, 68, 128, 38),
        "appearance": (12, 53, 84, 29),
        "refine": (15, 56, 110, 36),
        "best": (18, 83, 149, 41),  # with L2, smooth normals, and weights of normal consistency by texture
    },
}
CHANGED = 12  # graph nodes that hold a camera, an image or learning rates


@pytest.mark.parametrize("way", list(LIMITS))
def test_an_iteration_gives_the_device_no_more_to_do_than_before(way: str) -> None:
    for stage, row in host_cost(repeats=2, way=way).items():
        names = ("own_launches", "device_launches", "torch_operations", "allocations")
        for name, most in zip(names, LIMITS[way][stage], strict=True):
            assert 0 <= row[name] <= most, f"{stage}: {name}"
        assert row["own_launches"] > 0
        assert row["host_us"] > 0
        assert (0 < row["changed_nodes"] <= CHANGED) == (way == "graph")


@pytest.mark.parametrize("lengths", [[0], [5, 700, 0, 33, 32, 40_000, 31, 1 << 20], list(range(0, 3000, 7))])
def test_tiles_are_taken_longest_first_each_once(emulator: Emulator, lengths: list[int]) -> None:
    ends = torch.tensor(lengths).cumsum(0)
    ranges = torch.zeros(len(lengths) + 1, 2, dtype=torch.int64)
    ranges[:-1, 1], ranges[1:-1, 0] = ends, ends[:-1]
    order = torch.full((len(lengths),), -1, dtype=torch.int32)
    arguments = arguments_of("order_tiles", tiles=len(lengths), ranges=ranges, order=order)
    emulator.launch("order_tiles", 1, cuda_works.ORDER_THREADS, arguments)
    assert sorted(order.tolist()) == list(range(len(lengths)))
    chunks = [min(-(-lengths[tile] // 32), 511) for tile in order.tolist()]
    assert chunks == sorted(chunks, reverse=True)
    assert ctypes.sizeof(arguments) == 56


def test_rows_that_begin_in_the_middle_of_sixteen_bytes_have_the_same_gradients(
    emulator: Emulator, tmp_path: Path
) -> None:
    """A view of another tensor's rows is contiguous, but may start at any address."""
    import numpy as np

    from gs2d.render.cuda_backend import CudaBackend
    from gs2d.render.types import RasterSettings
    from render_scenes import contraction, random_camera, random_cotangents, random_splats, requiring_grad

    rng = np.random.default_rng(3)
    camera = random_camera(rng).resized(40, 30)
    splats, cotangents = random_splats(rng, camera, 70).to(dtype=torch.float32), random_cotangents(rng, camera)
    found = []
    for shift in (0, 1):
        scene = requiring_grad(splats)
        for name, tensor in list(scene.items()):
            room = torch.zeros(len(tensor) + 1, *tensor.shape[1:])
            room[shift : shift + len(tensor)] = tensor.detach()
            setattr(scene, name, room[shift : shift + len(tensor)].requires_grad_())
        output = CudaBackend(launcher=emulator, deterministic=True).rasterize(scene, camera, RasterSettings())
        contraction(output, cotangents).backward()
        found.append([tensor.grad for _, tensor in scene.items()])
    assert scene.means.data_ptr() % 16 != 0
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
