"""Rows without gradients, and chunked gradient sums over tiles, leave all other bits unchanged."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from benchmarks.stages import Passes, count_work
from benchmarks.workload import Workload, room_workload
from torch import Tensor

from gs2d.kernels.library import Library
from gs2d.render.api import rasterize
from gs2d.render.backends import get_backend
from gs2d.render.cpu_backend import CpuBackend
from gs2d.render.types import RasterSettings
from render_scenes import IMAGES, front_camera, requiring_grad, splat


@pytest.fixture(scope="module")
def room() -> Workload:
    return room_workload(3000, 150, 113)


def gradients(
    library: Library,
    room: Workload,
    images: tuple[str, ...],
    probe: int,
    rows: Tensor | None,
    names: tuple[str, ...] = (),
) -> tuple[list[Tensor], dict[str, Tensor]]:
    """Return images, and gradients of the parameters (or those named) and of the probe."""
    leaves = requiring_grad(room.splats.to(dtype=library.dtype))
    zeros = torch.zeros(len(leaves), max(probe, 2), dtype=library.dtype, requires_grad=probe > 0)
    settings = RasterSettings(background=(0.2, 0.5, 0.7))
    output = CpuBackend(library).rasterize(leaves, room.cameras[0], settings, zeros if probe else None, rows)
    chosen = [getattr(output, name) for name in images]
    generator = torch.Generator().manual_seed(7)
    given = [torch.randn(image.shape, generator=generator).to(image) for image in chosen]
    inputs = {name: tensor for name, tensor in leaves.items() if not names or name in names}
    inputs |= {"probe": zeros} if probe else {}
    found = torch.autograd.grad(chosen, list(inputs.values()), given)
    return [image.detach() for image in chosen], dict(zip(inputs, found, strict=True))


@pytest.mark.parametrize(
    ("images", "probe"), [(IMAGES, 0), (IMAGES, 4), (("color", "normal", "depth_mean"), 2), (("color",), 0)]
)
def test_rows_with_gradients_keep_their_bits_and_the_others_get_zero(
    any_native: Library, room: Workload, images: tuple[str, ...], probe: int
) -> None:
    if any_native.variant == "f64":
        room = replace(room, splats=room.splats.to(dtype=torch.float64))
    rows = torch.rand(len(room.splats), generator=torch.Generator().manual_seed(8)) < 0.05
    pictures, whole = gradients(any_native, room, images, probe, None)
    same, some = gradients(any_native, room, images, probe, rows)
    assert all(torch.equal(a, b) for a, b in zip(pictures, same, strict=True))
    for name, gradient in some.items():
        assert torch.equal(gradient[rows], whole[name][rows]), name
        assert not gradient[~rows].any(), name
        assert gradient[rows].any(), name


def test_the_same_where_only_colours_learn(native: Library, room: Workload) -> None:
    rows = torch.arange(len(room.splats)) % 9 == 0
    names = ("sh0", "shN")
    _, whole = gradients(native, room, ("color",), 0, None, names)
    _, some = gradients(native, room, ("color",), 0, rows, names)
    for name in names:
        assert torch.equal(some[name][rows], whole[name][rows])
        assert not some[name][~rows].any()
        assert some[name][rows].any()


def test_many_chunks_of_tiles_add_up_to_the_same_bits_on_any_number_of_threads(native: Library) -> None:
    workload = room_workload(3000, 300, 257)
    passes = Passes(native, workload, 3)
    output = passes.forward()
    passes.backward(output)
    work = count_work(native, output, 3000)
    assert work.largest_chunk <= 4096 < work.slots / 3  # at least four chunks
    found = []
    for threads in (1, 2, 3, 8, 2, 8):
        native.use_threads(threads)
        found.append(gradients(native, workload, IMAGES, 4, None)[1])
    for other in found[1:]:
        assert all(torch.equal(gradient, other[name]) for name, gradient in found[0].items())


def test_sums_are_the_same_with_and_without_room_in_the_gradient_of_the_coefficients(
    native: Library, room: Workload
) -> None:
    # with all parameters the sums use the rows of shN's gradient, without shN their own memory
    names = ("means", "quats", "log_scales", "opacity_logits", "sh0")
    _, inside = gradients(native, room, IMAGES, 4, None)
    _, outside = gradients(native, room, IMAGES, 4, None, names)
    assert all(torch.equal(inside[name], outside[name]) for name in (*names, "probe"))


def test_gradients_written_over_sums_are_the_same_for_any_number_of_coefficients(
    native: Library, room: Workload
) -> None:
    # 45 and 24 reals per row over 16 of sums: row i overwrites the sums of splats 2.8 i and 1.5 i. 9: does not fit
    splats, found = room.splats, {}
    for stored in (15, 8, 3):
        cut = Workload(room.name, replace(splats, shN=splats.shN[:, :stored].contiguous()), room.cameras)
        passes = Passes(native, cut, 1, probe_columns=4)
        output = passes.forward()
        inputs = [*(t for _, t in passes.leaves.items()), passes.signal]
        found[stored] = torch.autograd.grad((output.color**2).sum() + output.distortion.sum(), inputs)
    for stored in (8, 3):
        for of_all, gradient, tensor in zip(found[15], found[stored], inputs, strict=True):
            part = of_all if of_all.shape == gradient.shape else of_all[:, :stored]
            assert torch.equal(part, gradient), tensor.shape
    assert not found[15][5][:, 3:].any()  # degree 1


@pytest.mark.parametrize("name", ["reference", "cpu"])
def test_every_backend_masks_rows(name: str) -> None:
    backend = get_backend(name)
    scene = splat()
    two = type(scene)(**{k: torch.cat([t, t]) for k, t in scene.items()})
    two.means[1, 2] += 0.1
    rows = torch.tensor([False, True])
    whole, some = requiring_grad(two), requiring_grad(two)
    probes = [torch.zeros(2, 2, requires_grad=True) for _ in range(2)]
    rasterize(whole, front_camera(), backend=backend, screen_probe=probes[0]).color.sum().backward()
    rasterize(some, front_camera(), backend=backend, screen_probe=probes[1], gradient_rows=rows).color.sum().backward()
    for a, b in (*zip((t for _, t in whole.items()), (t for _, t in some.items()), strict=True), probes):
        if a.numel():
            assert a.grad is not None
            assert b.grad is not None
            assert torch.equal(a.grad[1], b.grad[1])
            assert not b.grad[0].any()
