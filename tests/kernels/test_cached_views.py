"""Cached views give the same image and gradients as full blending, for splats whose colours are trained."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import Splats
from gs2d.kernels.library import Library
from gs2d.render.cpu_backend import CpuBackend
from gs2d.render.cpu_cached import CachedView
from gs2d.render.types import RasterSettings

COUNT, ROOM = 300, 1 << 30


def make_splats(dtype: torch.dtype) -> Splats:
    """Return 300 splats in a ball; every tenth is so dark that its colour is clamped."""
    g = torch.Generator().manual_seed(4)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype)

    sh0 = 0.8 * normal(COUNT, 1, 3)
    sh0[::10, :, 1] = -4.0
    return Splats(
        means=0.4 * normal(COUNT, 3),
        quats=normal(COUNT, 4),
        log_scales=-1.8 + 0.3 * normal(COUNT, 2),
        opacity_logits=1.0 + normal(COUNT),
        sh0=sh0,
        shN=0.05 * normal(COUNT, 15, 3),
    )


def camera(width: int = 53, height: int = 41) -> Camera:
    """Return a camera whose image ends inside a tile on both axes."""
    up = np.array([0.0, 0.0, 1.0])
    return look_at(np.array([3.0, 0.0, 1.0]), np.zeros(3), up, width=width, height=height, fx=50.0)


def settings(degree: int = 3) -> RasterSettings:
    return RasterSettings(background=(0.1, 0.2, 0.3), sh_degree=degree)


ROWS = torch.arange(0, COUNT, 5)


def cached_view(library: Library, splats: Splats, degree: int = 3, rows: Tensor = ROWS) -> CachedView:
    view = CpuBackend(library).cache_view(splats, camera(), settings(degree), rows, limit_bytes=ROOM)
    assert view is not None
    return view


def differentiated(view: CachedView, splats: Splats, upstream: Tensor, rows: Tensor = ROWS) -> tuple[Tensor, ...]:
    """Return the image, and gradients of sh0 and shN for the rows."""
    sh0, shN = splats.sh0[rows].requires_grad_(), splats.shN[rows].requires_grad_()
    image = view.render(sh0, shN)
    image.backward(upstream)
    assert sh0.grad is not None
    assert shN.grad is not None
    return image.detach(), sh0.grad, shN.grad


def upstream_of(dtype: torch.dtype) -> Tensor:
    return torch.randn(41, 53, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_cached_view_has_the_image_to_rounding_and_the_gradients_to_the_bit(any_native: Library, degree: int) -> None:
    splats, upstream = make_splats(any_native.dtype), upstream_of(any_native.dtype)
    leaves = splats.clone()
    leaves.sh0.requires_grad_()
    leaves.shN.requires_grad_()
    plain = CpuBackend(any_native).rasterize(leaves, camera(), settings(degree)).color
    plain.backward(upstream)
    image, sh0, shN = differentiated(cached_view(any_native, splats, degree), splats, upstream)
    assert (image - plain.detach()).abs().max() <= (1e-14 if any_native.dtype == torch.float64 else 1e-6)
    assert leaves.sh0.grad is not None
    assert leaves.shN.grad is not None
    assert torch.equal(sh0, leaves.sh0.grad[ROWS])
    assert torch.equal(shN, leaves.shN.grad[ROWS])
    assert sh0.abs().amax() > 0.1
    if degree == 0:
        assert (sh0[::2, :, 1] == 0).all()  # the clamped channel of every tenth splat
        assert (shN == 0).all()


def test_the_weights_follow_the_colours_that_change_and_not_those_at_the_time_of_caching(native64: Library) -> None:
    splats = make_splats(native64.dtype)
    view = cached_view(native64, splats)
    painted = splats.clone()
    painted.sh0[ROWS] += torch.rand(len(ROWS), 1, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = CpuBackend(native64).rasterize(painted, camera(), settings()).color
    image = view.render(painted.sh0[ROWS], painted.shN[ROWS])
    assert (image - expected).abs().max() < 1e-14
    assert (image - CpuBackend(native64).rasterize(splats, camera(), settings()).color).abs().max() > 0.01
    again = cached_view(native64, painted)
    assert all(torch.equal(view.arrays[name], again.arrays[name]) for name in view.arrays)


def test_cached_views_have_the_same_bits_for_any_number_of_threads(native: Library) -> None:
    splats, upstream = make_splats(native.dtype), upstream_of(native.dtype)
    seen = []
    for threads in (1, 2, 3, 8):
        native.use_threads(threads)
        view = cached_view(native, splats)
        seen.append([*view.arrays.values(), *differentiated(view, splats, upstream)])
    for other in seen[1:]:
        assert all(torch.equal(a, b) for a, b in zip(seen[0], other, strict=True))


def test_a_view_is_cached_exactly_where_its_bytes_fit(native: Library) -> None:
    splats = make_splats(native.dtype)
    size = cached_view(native, splats).nbytes
    exact = CpuBackend(native).cache_view(splats, camera(), settings(), ROWS, limit_bytes=size)
    assert exact is not None
    assert exact.nbytes == size
    assert CpuBackend(native).cache_view(splats, camera(), settings(), ROWS, limit_bytes=size - 1) is None


@pytest.mark.parametrize("rows", [[], [7]])
def test_without_a_visible_row_the_frozen_image_is_the_plain_one_to_the_bit(native: Library, rows: list[int]) -> None:
    splats, learning = make_splats(native.dtype), torch.tensor(rows, dtype=torch.int64)
    splats.means[7] = torch.tensor([9.0, 0.0, 1.0])  # behind the camera
    view = cached_view(native, splats, rows=learning)
    image, sh0, shN = differentiated(view, splats, upstream_of(native.dtype), learning)
    assert torch.equal(image, CpuBackend(native).rasterize(splats, camera(), settings()).color)
    assert len(view.arrays["entry_row"]) == 0
    assert (sh0 == 0).all()
    assert (shN == 0).all()
    assert sh0.shape == (len(rows), 1, 3)


def test_a_row_at_the_camera_centre_is_unseen_and_leaves_no_nan(native: Library) -> None:
    splats = make_splats(native.dtype)
    splats.means[5] = torch.as_tensor(camera().center).to(native.dtype)
    image, sh0, shN = differentiated(cached_view(native, splats), splats, upstream_of(native.dtype))
    assert all(bool(torch.isfinite(t).all()) for t in (image, sh0, shN))
    assert (sh0[1] == 0).all()
