"""Loss definitions, checked against hand-computed values."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from gs2d.errors import ShapeError
from gs2d.losses import formulas as reference
from gs2d.losses.formulas import normals_from_depth
from loss_images import make_camera, make_output, plane_depth

per_splat_consistency = partial(reference.normal_consistency, per_splat=True)


def test_l1_is_the_mean_absolute_difference_over_pixels_and_channels() -> None:
    rendered = torch.tensor([[[0.5, 0.5, 0.5], [1.0, 0.0, 0.0]]])
    target = torch.tensor([[[0.5, 0.25, 1.0], [0.0, 0.0, 0.0]]])
    assert reference.l1(rendered, target).item() == pytest.approx((0 + 0.25 + 0.5 + 1) / 6)


def test_ssim_of_two_flat_images_far_from_the_border_is_the_luminance_term() -> None:
    x, y = torch.full((13, 13, 3), 0.3, dtype=torch.float64), torch.full((13, 13, 3), 0.6, dtype=torch.float64)
    # no variance: (2 mu_x mu_y + C1) / (mu_x^2 + mu_y^2 + C1) with C1 = 1e-4
    assert reference.ssim_map(x, y)[6, 6, 0].item() == pytest.approx((0.36 + 1e-4) / (0.45 + 1e-4), rel=1e-9)


def test_ssim_pads_with_zeros() -> None:
    # Single pixel: only the window's centre weight g overlaps the image, so mu = g v and E[v v'] = g v v'.
    g = reference.gaussian_window()[5].item() ** 2
    x, y = 0.4, 0.9
    mu_x, mu_y, var_x, var_y, cov = g * x, g * y, g * x * x, g * y * y, g * x * y
    by_hand = (2 * mu_x * mu_y + 1e-4) * (2 * (cov - mu_x * mu_y) + 9e-4)
    by_hand /= (mu_x**2 + mu_y**2 + 1e-4) * (var_x + var_y - mu_x**2 - mu_y**2 + 9e-4)
    one = torch.ones(1, 1, 3, dtype=torch.float64)
    assert reference.ssim(one * x, one * y).item() == pytest.approx(by_hand, rel=1e-12)


def test_ssim_agrees_with_torchmetrics_where_the_window_is_inside_the_image() -> None:
    g = torch.Generator().manual_seed(3)
    x = torch.rand(40, 33, 3, generator=g, dtype=torch.float64)
    y = (x + 0.2 * torch.randn(40, 33, 3, generator=g, dtype=torch.float64)).clamp(0, 1)
    _, theirs = structural_similarity_index_measure(
        x.permute(2, 0, 1)[None], y.permute(2, 0, 1)[None], sigma=1.5, data_range=1.0, return_full_image=True
    )  # skimage reflects at the border, gs2d pads with zeros: compare only where the window is inside
    ours = reference.ssim_map(x, y)
    torch.testing.assert_close(ours[5:-5, 5:-5], theirs[0].permute(1, 2, 0)[5:-5, 5:-5], rtol=1e-9, atol=0)
    assert (ours - theirs[0].permute(1, 2, 0)).abs().max() > 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_the_depth_of_a_plane_gives_the_normal_of_the_plane_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = make_camera(11, 9)
    normal = -camera.forward + 0.5 * rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    depth = plane_depth(camera, normal, offset=float(normal @ camera.center) - 2.0)
    keep = depth > 0
    surface = normals_from_depth(torch.where(keep, depth, torch.zeros_like(depth)), camera)
    inner = keep[2:, 1:-1] & keep[:-2, 1:-1] & keep[1:-1, 2:] & keep[1:-1, :-2]
    assert inner.sum() > 40
    found = surface[1:-1, 1:-1][inner].numpy()
    np.testing.assert_allclose(found, np.broadcast_to(normal, found.shape), atol=1e-12)


def test_the_border_and_pixels_beside_the_background_have_no_normal() -> None:
    camera = make_camera(7, 6)
    depth = torch.full((6, 7), 2.0)
    depth[2, 3] = 0
    length = normals_from_depth(depth, camera).norm(dim=-1)
    expected = torch.zeros(6, 7)
    expected[1:-1, 1:-1] = 1
    for row, column in [(1, 3), (3, 3), (2, 2), (2, 4)]:  # the hole's neighbours use it; the hole itself does not
        expected[row, column] = 0
    torch.testing.assert_close(length, expected)


def test_with_camera_edges_an_empty_neighbour_lies_at_the_cameras_centre() -> None:
    camera, generator = make_camera(11, 9), torch.Generator().manual_seed(1)
    depth = 1 + torch.rand(9, 11, generator=generator, dtype=torch.float64)
    depth = torch.where(torch.rand(9, 11, generator=generator) < 0.4, 0.0, depth)
    i, j = np.meshgrid(np.arange(11) + 0.5, np.arange(9) + 0.5)
    rays = np.stack([(i - camera.cx) / camera.fx, (j - camera.cy) / camera.fy, np.ones_like(i)], axis=-1)
    points = camera.center + depth.numpy()[..., None] * (rays @ camera.rotation)  # the camera centre where empty
    down, right = points[2:, 1:-1] - points[:-2, 1:-1], points[1:-1, 2:] - points[1:-1, :-2]
    product = np.cross(down, right)
    length = np.linalg.norm(product, axis=-1, keepdims=True)
    expected = np.where(length > 1e-12, product / np.maximum(length, 1e-12), 0.0)
    found = normals_from_depth(depth, camera, edges="camera")
    assert ((length == 0).any(), (length > 0).mean() > 0.5) == (True, True)
    np.testing.assert_allclose(found[1:-1, 1:-1].numpy(), expected, atol=1e-12)
    beside = normals_from_depth(depth, camera).norm(dim=-1) == 0  # includes the border
    assert (found[beside].norm(dim=-1) > 0.5).sum() > 20
    torch.testing.assert_close(found[~beside], normals_from_depth(depth, camera)[~beside])


@pytest.mark.parametrize("mask_one", [(2, 3), (1, 2)])
def test_with_camera_edges_an_ignored_neighbour_still_leaves_no_normal(mask_one: tuple[int, int]) -> None:
    camera, depth = make_camera(7, 6), torch.full((6, 7), 2.0)
    depth[3, 3] = 0
    mask = torch.ones(6, 7, dtype=torch.bool)
    mask[mask_one] = False
    normals = normals_from_depth(depth, camera, mask, edges="camera")
    row, column = mask_one
    for away in [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)]:
        assert (normals[row + away[0], column + away[1]] == 0).all()
    assert normals[4, 3].norm() > 0.5  # the pixel above is empty, not ignored


@pytest.mark.parametrize("loss", [reference.normal_consistency, per_splat_consistency])
def test_with_camera_edges_gradients_are_those_of_finite_differences_and_0_where_empty(
    loss: Callable[..., Tensor],
) -> None:
    camera, output, g = make_camera(9, 8), make_output(8, 9), torch.Generator().manual_seed(2)
    empty = torch.rand(8, 9, generator=g) < 0.3
    weights = torch.rand(8, 9, generator=g, dtype=torch.float64)
    alpha = output.alpha.detach()

    def value(normal: Tensor, depth: Tensor) -> Tensor:
        seen = torch.where(empty, 0.0, depth)
        return loss(normal, seen, alpha, camera, edges="camera", weights=weights)

    assert torch.autograd.gradcheck(value, (output.normal, output.depth_mean))
    depth = torch.where(empty, 0.0, output.depth_mean.detach()).requires_grad_()
    (gradient,) = torch.autograd.grad(loss(output.normal, depth, alpha, camera, edges="camera"), depth)
    assert (gradient[empty] == 0).all()
    assert gradient.isfinite().all()


def test_weights_multiply_the_part_of_each_pixel_and_the_count_stays() -> None:
    camera, output = make_camera(9, 8), make_output(8, 9)
    images = (output.normal, output.depth_mean, output.alpha, camera)
    mask = torch.rand(8, 9, generator=torch.Generator().manual_seed(0)) < 0.9
    for loss in (reference.normal_consistency, per_splat_consistency):
        parts = torch.zeros((), dtype=torch.float64)
        for row in range(2):  # upper and lower half, selected by weights of 0 and 1
            half = torch.zeros(8, 9, dtype=torch.float64)
            half[4 * row : 4 * row + 4] = 1
            parts = parts + (row + 2) * loss(*images, mask, weights=half)
        whole = torch.full((8, 9), 2.0, dtype=torch.float64)
        whole[4:] = 3
        torch.testing.assert_close(loss(*images, mask, weights=whole), parts)
        torch.testing.assert_close(loss(*images, mask, weights=torch.ones_like(whole)), loss(*images, mask))


def test_flatness_is_high_without_texture_and_low_with_it() -> None:
    """The variance is that of windows of 7 x 7, smaller at the border."""
    generator = torch.Generator().manual_seed(2)
    image = torch.full((12, 20, 3), 0.4, dtype=torch.float64)
    image[:, 10:] += 0.05 * torch.rand(12, 10, 1, generator=generator, dtype=torch.float64)
    found = reference.flatness(image)
    assert found.dtype == torch.uint8
    assert (found[:, :7] == 255).all()
    grey = image[..., 0].numpy()
    for y, x in ((0, 0), (5, 12), (11, 19), (3, 8)):
        window = grey[max(y - 3, 0) : y + 4, max(x - 3, 0) : x + 4]
        assert abs(int(found[y, x]) - 255 * np.exp(-window.var() / 0.02**2)) <= 0.5 + 1e-6
    assert found[:, 13:].float().mean() < 220


def test_normal_smoothness_is_the_bend_between_opaque_pixels_without_texture() -> None:
    normal = torch.zeros(6, 8, 3, dtype=torch.float64)
    normal[..., 2] = -1
    normal[:, 4:] = torch.tensor([-1.0, 0, 0])  # an edge: two columns on each side are compared across it
    alpha, flat = torch.ones(6, 8, dtype=torch.float64), torch.full((6, 8), 255, dtype=torch.uint8)
    bend = 2 * 6 * (math.sqrt(2 + reference.SMOOTH_BEND**2) - reference.SMOOTH_BEND) / 48
    assert reference.normal_smoothness(normal, alpha, flat).item() == pytest.approx(bend)
    half = torch.where(torch.arange(6)[:, None] < 3, flat, 0)
    assert reference.normal_smoothness(normal, alpha, half).item() == pytest.approx(bend / 2)
    assert reference.normal_smoothness(normal, 0.5 * alpha, flat).item() == 0  # not opaque
    mask = (torch.arange(8) < 4).expand(6, 8)
    normal[:, 6] = torch.nan  # ignored
    assert reference.normal_smoothness(normal, alpha, flat, mask).item() == 0


def test_flat_weights_go_from_one_to_the_factor() -> None:
    weights = reference.flat_weights(torch.tensor([[0, 255]], dtype=torch.uint8), 6.0, torch.float32)
    assert weights.tolist() == [[1.0, 6.0]]


def test_object_weights_use_the_alpha_of_the_image_or_the_rendered_alpha() -> None:
    rendered, photographed = torch.tensor([[0.25, 0.75]], requires_grad=True), torch.tensor([[0.51, 0.5]])
    assert reference.object_weights(rendered, photographed).tolist() == [[1.0, 0.0]]
    assert reference.object_weights(rendered).tolist() == [[0.25, 0.75]]
    assert not reference.object_weights(rendered).requires_grad


@given(seed=st.integers(0, 10_000), size=st.tuples(st.integers(3, 9), st.integers(3, 9)))
@settings(max_examples=25, deadline=None)
def test_normals_from_depth_face_the_camera_whatever_the_depth(seed: int, size: tuple[int, int]) -> None:
    height, width = size
    camera = make_camera(width, height)
    g = torch.Generator().manual_seed(seed)
    depth = torch.exp(2 * torch.randn(height, width, generator=g, dtype=torch.float64))
    i, j = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(i - camera.cx) / camera.fx, (j - camera.cy) / camera.fy, np.ones_like(i)], axis=-1)
    towards = (normals_from_depth(depth, camera).numpy() * (rays @ camera.rotation)).sum(axis=-1)
    assert (towards[1:-1, 1:-1] < 0).all()


def test_normal_consistency_of_a_true_plane_is_one_minus_alpha_squared_inside_and_one_on_the_border() -> None:
    camera = make_camera(8, 6)
    normal = -camera.forward
    depth = plane_depth(camera, normal, offset=float(normal @ camera.center) - 3.0)
    alpha = torch.full((6, 8), 0.75, dtype=torch.float64)
    rendered = alpha[..., None] * torch.from_numpy(normal)  # sum w n
    value = reference.normal_consistency(rendered, depth, alpha, camera)
    # 24 of 48 pixels are inside: (24 (1 - 0.75^2) + 24) / 48
    assert value.item() == pytest.approx((24 * (1 - 0.5625) + 24) / 48)
    per_splat = per_splat_consistency(rendered, depth, alpha, camera)
    assert per_splat.item() == pytest.approx(0, abs=1e-12)  # alpha - alpha <n, N>


def test_only_the_per_splat_form_has_a_gradient_through_alpha() -> None:
    camera, output = make_camera(6, 5), make_output(5, 6)
    inputs = (output.normal, output.depth_mean, output.alpha)
    official = torch.autograd.grad(reference.normal_consistency(*inputs, camera), inputs, allow_unused=True)
    assert official[2] is None
    assert official[0].abs().sum() > 0
    assert official[1].abs().sum() > 0
    per_splat = torch.autograd.grad(per_splat_consistency(*inputs, camera), inputs)
    expected = torch.zeros(5, 6, dtype=torch.float64)
    expected[1:-1, 1:-1] = 1 / 30  # d/d alpha of the mean, where N is defined
    torch.testing.assert_close(per_splat[2], expected)


def test_the_silhouette_loss_sees_a_splat_that_has_the_colour_of_the_background() -> None:
    # Two empty pixels and two of the object; alpha 0.5 on one empty pixel: |0.5 - 0| / 4 = 0.125.
    alpha = torch.tensor([[0.5, 0.0], [1.0, 1.0]], requires_grad=True)
    wanted = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
    value = reference.silhouette(alpha, wanted)
    assert value.item() == 0.125
    assert torch.autograd.grad(value, alpha)[0].tolist() == [[0.25, 0.0], [0.0, 0.0]]
    # Without that pixel the other three have no error.
    assert reference.silhouette(alpha, wanted, torch.tensor([[False, True], [True, True]])).item() == 0.0


def test_normals_of_depth_of_another_size_or_with_unknown_edges_are_refused() -> None:
    camera, depth = make_camera(9, 8), torch.ones(8, 9, dtype=torch.float64)
    with pytest.raises(ShapeError, match="depth"):
        normals_from_depth(depth.T, camera)
    with pytest.raises(ShapeError, match="mask"):
        normals_from_depth(depth, camera, torch.ones(8, 1, dtype=torch.bool))
    with pytest.raises(ShapeError, match="undefined"):
        normals_from_depth(depth, camera, edges="clamp")
