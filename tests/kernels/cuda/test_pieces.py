"""Long tile lists in pieces, emulated: images and gradients of whole lists, up to rounding."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from benchmarks.tile_lists import parts_of
from torch import Tensor

from emulate import Emulator
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.kernels.cuda.kernel_arguments import work_of
from gs2d.render import cuda_passes, cuda_works
from gs2d.render.cuda_backend import CudaBackend
from kernel_cases import SETTINGS, many_tiles
from render_scenes import IMAGES, contraction, front_camera, random_cotangents, requiring_grad, splat, stack

EVERYTHING = replace(SETTINGS, sh_degree=0, with_transmittance_depth=True)


@pytest.fixture(autouse=True)
def short_pieces() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda_works, "SHORTEST_PIECE", 32)
        yield


@pytest.fixture(scope="module")
def deep() -> tuple[Splats, Camera]:
    """Return 300 tilted layers: on the left pixels stop early or late, on the right nearly all light passes."""
    rng = np.random.default_rng(3)
    parts = []
    for _i in range(300):
        x = rng.uniform(-2, 2)
        opacity = 0.03 if x > 0.6 else rng.choice([0.05, 0.3, 0.7])
        mean, scales = (x, rng.uniform(-1, 1), rng.uniform(2, 6)), (rng.uniform(0.3, 0.8), rng.uniform(0.2, 0.6))
        parts.append(splat(mean, scales, opacity, tuple(rng.random(3)), (0.0, 1.0, 0.0), rng.uniform(-50, 50)))
    return stack(*parts), front_camera(20, 12, 12.0)


def rendered(launcher: Any, scene: tuple[Splats, Camera], **options: Any) -> dict[str, Tensor]:
    """Return images, and gradients of all parameters and of the densification signal."""
    splats, camera = requiring_grad(scene[0]), scene[1]
    probe = torch.zeros(len(splats), 4, requires_grad=True)
    backend = CudaBackend(launcher=launcher, deterministic=True, **options)
    output = backend.rasterize(splats, camera, EVERYTHING, probe)
    cotangents = random_cotangents(np.random.default_rng(1), camera)
    (contraction(output, cotangents) + output.depth_transmittance.mean()).backward()
    grads = {f"gradient of {name}": tensor.grad for name, tensor in splats.items()} | {"probe": probe.grad}
    images = {name: getattr(output, name).detach() for name in (*IMAGES, "depth_transmittance")}
    return images | {name: grad for name, grad in grads.items() if grad is not None and grad.numel()}


def frame_of(launcher: Any, scene: tuple[Splats, Camera], **options: Any) -> cuda_passes.ForwardState:
    view = cuda_passes.view_of(scene[1], EVERYTHING)
    return cuda_passes.forward(
        launcher, view, {name: tensor.contiguous() for name, tensor in scene[0].items()}, **options
    )


def pieces_of(memory: Tensor) -> list[int]:
    """Return the tile of each piece."""
    rows = parts_of(memory)[1][:-1].view(-1, cuda_works.PIECE_ROW)
    return [int(tile) for tile in rows[:, 0] if tile >= 0]


def words_of(frame: cuda_passes.ForwardState) -> Tensor:
    """Return the words of all chunks, without gaps."""
    rows = [
        (begin >> 5) + tile + chunk
        for tile, (begin, end) in enumerate(frame.ranges[:-1].tolist())
        for chunk in range(-(-(end - begin) // 32))
    ]
    return frame.seen[rows]


def close(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    for name, values in expected.items():
        assert float((found[name] - values).norm()) <= tolerance * float(values.norm()), name


def test_pieces_give_the_images_and_gradients_of_whole_lists(
    emulator: Emulator, deep: tuple[Splats, Camera], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The relative difference is of rounding: a product of transmittances, and sums in another order."""
    frame = frame_of(emulator, deep)
    assert len(pieces_of(frame.pieces)) >= 8
    assert float(frame.images["alpha"].max()) > 0.999  # some pixels stop
    assert float(frame.images["alpha"].min()) < 0.5  # the last pair is the median of others
    pieces = rendered(emulator, deep)
    monkeypatch.setattr(cuda_works, "MOST_PIECES", 0)
    whole, uncut = rendered(emulator, deep), frame_of(emulator, deep)
    assert len(uncut.pieces) == 1
    assert torch.equal(words_of(frame), words_of(uncut))
    assert torch.equal(pieces["depth_median"], whole["depth_median"])
    close(pieces, whole, 1e-5)
    assert any(not torch.equal(pieces[name], whole[name]) for name in IMAGES)


def test_the_order_of_blocks_does_not_change_a_bit(emulator: Emulator, deep: tuple[Splats, Camera]) -> None:
    usual = rendered(emulator, deep)
    for other in (replace(emulator, descending=True), replace(emulator, seed=2)):
        found = rendered(other, deep)
        assert all(torch.equal(found[name], values) for name, values in usual.items())


def test_only_tiles_with_long_lists_change(emulator: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    case = many_tiles()
    frame = frame_of(emulator, (case.splats, case.camera))
    cut = set(pieces_of(frame.pieces))
    monkeypatch.setattr(cuda_works, "MOST_PIECES", 0)
    whole = frame_of(emulator, (case.splats, case.camera))
    differ = (frame.images["color"] != whole.images["color"]).any(dim=2)
    tiles_x = int(frame.view.tiles_x)
    changed = {int(y) // 16 * tiles_x + int(x) // 16 for y, x in differ.nonzero()}
    assert changed <= cut < set(range(len(frame.tiles)))


def test_colour_gradients_alone_agree(
    emulator: Emulator, deep: tuple[Splats, Camera], monkeypatch: pytest.MonkeyPatch
) -> None:
    def of_colors() -> dict[str, Tensor]:
        splats = Splats(**{name: t.clone().requires_grad_(name == "sh0") for name, t in deep[0].items()})
        rows = torch.arange(len(splats)) % 3 == 0
        backend = CudaBackend(launcher=emulator, deterministic=True)
        output = backend.rasterize(splats, deep[1], EVERYTHING, gradient_rows=rows)
        output.color.square().sum().backward()
        assert splats.sh0.grad is not None
        return {"sh0": splats.sh0.grad}

    pieces = of_colors()
    monkeypatch.setattr(cuda_works, "MOST_PIECES", 0)
    close(pieces, of_colors(), 1e-5)


@pytest.mark.parametrize("lengths", [[0], [63, 64, 65, 0, 200], [5000, 1, 127, 128, 40_000, 70]])
def test_pieces_are_as_long_as_the_average_and_have_room(emulator: Emulator, lengths: list[int]) -> None:
    ends = torch.tensor(lengths).cumsum(0)
    ranges = torch.zeros(len(lengths) + 1, 2, dtype=torch.int64)
    ranges[:-1, 1], ranges[1:-1, 0] = ends, ends[:-1]
    shortest, most = 32, 100
    capacity = min(most, int(ends[-1]) // shortest)
    memory = torch.zeros(capacity * (cuda_works.PIECE_STATE + cuda_works.PIECE_ROW) + 1)
    table = parts_of(memory)[1].fill_(7)
    order = torch.empty(len(lengths), dtype=torch.int32)
    limits = {"tiles": len(lengths), "capacity": capacity, "shortest": shortest, "most": most}
    tensors = {"ranges": ranges, "order": order, "pieces": table if capacity else None}
    emulator.run([work_of("order_tiles", 1, limits, tensors, threads=cuda_works.ORDER_THREADS)])
    length = max(shortest, -(-sum(lengths) // most))
    expected = {tile: n // length for tile, n in enumerate(lengths) if n >= 2 * length}
    if capacity == 0:
        assert (table == 7).all()
        return
    tiles = pieces_of(memory)
    assert {tile: tiles.count(tile) for tile in tiles} == expected
    rows = table[:-1].view(capacity, cuda_works.PIECE_ROW)
    assert int(table[-1]) == length
    assert not rows[:, 2:].any()
    for i, tile in enumerate(tiles):
        assert tiles.index(tile) == int(rows[i, 1])
