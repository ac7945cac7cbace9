"""Memory of large tensors is reused, but only when no tensor refers to it."""

from __future__ import annotations

import copy

import torch
from benchmarks.workload import room_workload

from gs2d.core.splats import IMAGES, Splats
from gs2d.kernels.buffer_pool import LINE, BufferPool
from gs2d.kernels.library import Library
from gs2d.render.cpu_backend import CpuBackend
from gs2d.render.types import RasterSettings

FLOAT = torch.float32


def test_memory_comes_back_when_the_last_view_of_a_tensor_is_gone() -> None:
    pool = BufferPool(min_bytes=64)
    tensor = pool.empty((10, 3), FLOAT)
    first, row = tensor.data_ptr(), tensor[4]
    assert tensor.is_contiguous()
    assert tensor.shape == (10, 3)
    assert first % LINE == 0
    del tensor
    assert pool.free_bytes == 0  # the row still refers to it
    other = pool.empty((10, 3), FLOAT)
    assert other.data_ptr() != first
    del row
    assert pool.free_bytes > 0
    assert pool.empty((9, 3), FLOAT).data_ptr() == first  # 27 of 30 reals


def test_blocks_of_other_sizes_wait_for_their_next_request_but_not_for_ever() -> None:
    pool = BufferPool(min_bytes=64)
    kept, small = pool.empty((100_000,), FLOAT), (100,)
    del kept
    for _ in range(64):
        pool.empty(small, FLOAT)
        assert pool.free_bytes > 400_000
    pool.empty(small, FLOAT)
    assert pool.free_bytes < 1000


def test_images_and_gradients_in_used_memory_have_the_same_bits(native: Library) -> None:
    recycling = copy.copy(native)
    recycling.pool = BufferPool(min_bytes=1)
    room = room_workload(300, 40, 33)

    def differentiated(library: Library) -> list[torch.Tensor]:
        leaves = Splats(**{name: t.clone().requires_grad_() for name, t in room.splats.items()})
        output = CpuBackend(library).rasterize(leaves, room.cameras[0], RasterSettings())
        images = [getattr(output, name) for name in IMAGES]
        total = torch.stack([(image * image).sum() for image in images]).sum()
        found = torch.autograd.grad(total, [t for _, t in leaves.items()])
        return [*(image.detach() for image in images), output.radii, *found]

    expected, first = differentiated(native), differentiated(recycling)
    assert recycling.pool.free_bytes == 0
    held = first[0].data_ptr()
    for tensor in first[1:]:
        tensor.fill_(float("nan"))
    del first[1:], tensor
    assert recycling.pool.free_bytes > 0
    second = differentiated(recycling)
    assert held not in {t.data_ptr() for t in second}
    for a, b in zip(expected, second, strict=True):
        assert torch.equal(a, b)
