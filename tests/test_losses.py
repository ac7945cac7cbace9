"""The losses: definitions by hand-worked numbers, masks, gradients, and the terms of a recipe."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from gs2d import losses_reference as reference
from gs2d.camera import Camera, look_at
from gs2d.errors import BackendError, RecipeError, ShapeError
from gs2d.kernels.library import load
from gs2d.losses import FUSED_LOSSES, LOSSES, compute_losses, normals_from_depth, target_maps
from gs2d.recipe import LossTerm
from gs2d.render.types import RenderOutput


@pytest.fixture
def native() -> None:
    """Skip where the native library is not built."""
    try:
        load()
    except BackendError as error:
        pytest.skip(str(error))


OFFICIAL = (
    LossTerm("l1", 0.8),
    LossTerm("ssim", 0.2),
    LossTerm("normal_consistency", 0.05, start=7000),
    LossTerm("distortion", 100.0, start=3000),
)


def make_camera(width: int, height: int) -> Camera:
    """A camera with nothing symmetric about it."""
    T = look_at(
        np.array([1.0, -2.0, 0.7]), np.zeros(3), np.array([0.1, 0.2, 1.0]), width=width, height=height, fx=1.0
    ).T_cam_world
    return Camera(width, height, 0.9 * width, 1.1 * width, 0.4 * width, 0.55 * height, T)


def make_output(height: int, width: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> RenderOutput:
    """Random images that could come from a rasterizer, all requiring gradients."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64).to(dtype)

    return RenderOutput(
        color=rand(height, width, 3).requires_grad_(),
        alpha=rand(height, width).requires_grad_(),
        normal=(rand(height, width, 3) - 0.5).requires_grad_(),
        depth_mean=(1 + rand(height, width)).requires_grad_(),
        depth_median=(1 + rand(height, width)).requires_grad_(),
        distortion=rand(height, width).requires_grad_(),
        radii=torch.zeros(0),
    )


def plane_depth(camera: Camera, normal_world: np.ndarray, offset: float) -> Tensor:
    """Exact z-depth [H, W] of the plane {X: normal . X = offset}."""
    i, j = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(i - camera.cx) / camera.fx, (j - camera.cy) / camera.fy, np.ones_like(i)], axis=-1)
    rays_world = rays @ camera.rotation  # z = 1 along each ray
    return torch.from_numpy((offset - normal_world @ camera.center) / (rays_world @ normal_world))


def test_l1_is_the_mean_absolute_difference_over_pixels_and_channels() -> None:
    rendered = torch.tensor([[[0.5, 0.5, 0.5], [1.0, 0.0, 0.0]]])
    target = torch.tensor([[[0.5, 0.25, 1.0], [0.0, 0.0, 0.0]]])
    assert reference.l1(rendered, target).item() == pytest.approx((0 + 0.25 + 0.5 + 1) / 6)


def test_l1_with_a_mask_averages_over_valid_pixels_only() -> None:
    rendered = torch.tensor([[[0.5, 0.5, 0.5], [1.0, 0.0, 0.0]]])
    target = torch.tensor([[[0.5, 0.25, 1.0], [0.0, 0.0, 0.0]]])
    assert reference.l1(rendered, target, torch.tensor([[True, False]])).item() == pytest.approx(0.75 / 3)


def test_the_window_is_normalised_and_its_weights_are_those_of_sigma_one_and_a_half() -> None:
    window = reference.gaussian_window()
    assert window.sum().item() == pytest.approx(1, abs=1e-15)
    # neighbours: exp(-1/4.5) apart at the centre; the outermost exp(-25/4.5) below it
    assert (window[6] / window[5]).item() == pytest.approx(np.exp(-1 / 4.5))
    assert (window[0] / window[5]).item() == pytest.approx(np.exp(-25 / 4.5))


def test_ssim_of_two_flat_images_far_from_the_border_is_the_luminance_term() -> None:
    x, y = torch.full((13, 13, 3), 0.3, dtype=torch.float64), torch.full((13, 13, 3), 0.6, dtype=torch.float64)
    # no variance: (2 mu_x mu_y + C1) / (mu_x^2 + mu_y^2 + C1) with C1 = 1e-4
    assert reference.ssim_map(x, y)[6, 6, 0].item() == pytest.approx((0.36 + 1e-4) / (0.45 + 1e-4), rel=1e-9)


def test_ssim_pads_with_zeros() -> None:
    # A single pixel: only the centre weight g of the window meets the image, so mu = g v and E[v v'] = g v v'.
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
    )  # it reflects at the border where we pad with zeros: compare where the window is inside
    ours = reference.ssim_map(x, y)
    torch.testing.assert_close(ours[5:-5, 5:-5], theirs[0].permute(1, 2, 0)[5:-5, 5:-5], rtol=1e-9, atol=0)
    assert (ours - theirs[0].permute(1, 2, 0)).abs().max() > 1e-3


def test_ssim_of_an_image_with_itself_is_one() -> None:
    x = torch.rand(9, 12, 3, dtype=torch.float64)
    assert reference.ssim(x, x).item() == pytest.approx(1, abs=1e-12)


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


@pytest.mark.parametrize("size", [(1, 1), (2, 5), (5, 2)])
def test_an_image_without_inner_pixels_has_normal_consistency_one(size: tuple[int, int]) -> None:
    output = make_output(*size)
    value = reference.normal_consistency(output.normal, output.depth_mean, output.alpha, make_camera(size[1], size[0]))
    assert value.item() == pytest.approx(1)


def test_normal_consistency_of_a_true_plane_is_one_minus_alpha_squared_inside_and_one_on_the_border() -> None:
    camera = make_camera(8, 6)
    normal = -camera.forward
    depth = plane_depth(camera, normal, offset=float(normal @ camera.center) - 3.0)
    alpha = torch.full((6, 8), 0.75, dtype=torch.float64)
    rendered = alpha[..., None] * torch.from_numpy(normal)  # sum w n
    value = reference.normal_consistency(rendered, depth, alpha, camera)
    # 24 of 48 pixels are inside: (24 (1 - 0.75^2) + 24) / 48
    assert value.item() == pytest.approx((24 * (1 - 0.5625) + 24) / 48)
    per_splat = reference.normal_consistency_per_splat(rendered, depth, alpha, camera)
    assert per_splat.item() == pytest.approx(0, abs=1e-12)  # alpha - alpha <n, N>


def test_only_the_per_splat_form_has_a_gradient_through_alpha() -> None:
    camera, output = make_camera(6, 5), make_output(5, 6)
    inputs = (output.normal, output.depth_mean, output.alpha)
    official = torch.autograd.grad(reference.normal_consistency(*inputs, camera), inputs, allow_unused=True)
    assert official[2] is None
    assert official[0].abs().sum() > 0
    assert official[1].abs().sum() > 0
    per_splat = torch.autograd.grad(reference.normal_consistency_per_splat(*inputs, camera), inputs)
    expected = torch.zeros(5, 6, dtype=torch.float64)
    expected[1:-1, 1:-1] = 1 / 30  # d/d alpha of the mean, where N is defined
    torch.testing.assert_close(per_splat[2], expected)


def test_gradients_stay_finite_beside_the_background() -> None:
    camera, output = make_camera(9, 8), make_output(8, 9)
    depth = torch.where(torch.rand(8, 9) < 0.3, 0.0, output.depth_mean.detach()).requires_grad_()
    for loss in (reference.normal_consistency, reference.normal_consistency_per_splat):
        (gradient,) = torch.autograd.grad(loss(output.normal, depth, output.alpha, camera), depth)
        assert gradient.isfinite().all()
        assert (gradient[depth == 0] == 0).all()
        assert gradient.abs().sum() > 0


@pytest.mark.parametrize("kind", list(LOSSES))
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_what_was_rendered_at_an_ignored_pixel_has_no_influence(
    kind: str, backend: str, request: pytest.FixtureRequest
) -> None:
    if backend == "cpu":
        request.getfixturevalue("native")
    height, width = 14, 17
    camera, target = make_camera(width, height), torch.rand(height, width, 3)
    mask = torch.rand(height, width, generator=torch.Generator().manual_seed(5)) < 0.8
    values, gradients = [], []
    for junk in (0.0, 7.0, float("nan")):
        clean = make_output(height, width, dtype=torch.float32)
        leaves = {
            name: torch.where(
                mask if image.dim() == 2 else mask[..., None], image.detach(), torch.full_like(image.detach(), junk)
            ).requires_grad_()
            for name, image in vars(clean).items()
            if name != "radii"
        }
        output = RenderOutput(**leaves, radii=clean.radii)
        losses = compute_losses(
            output,
            target,
            mask,
            camera,
            [LossTerm(kind, 1.0)],
            iteration=1,
            depth_kind="mean",
            backend_name=backend,
            silhouette=target[..., 0],
        )
        values.append(losses[kind].item())
        found = torch.autograd.grad(losses[kind], list(leaves.values()), allow_unused=True)
        gradients.append([g for g in found if g is not None])
    assert values[0] == values[1] == values[2]
    assert gradients[0]
    for first, *others in zip(*gradients, strict=True):
        assert first.abs().sum() > 0
        assert (first[~mask] == 0).all()
        for other in others:
            assert torch.equal(first, other)


@pytest.mark.parametrize("kind", list(LOSSES))
def test_an_all_true_mask_changes_nothing(kind: str) -> None:
    output, camera, target = make_output(12, 13), make_camera(13, 12), torch.rand(12, 13, 3, dtype=torch.float64)
    term = [LossTerm(kind, 1.0)]
    plain, masked = (
        compute_losses(
            output,
            target,
            mask,
            camera,
            term,
            iteration=1,
            depth_kind="median",
            backend_name="reference",
            silhouette=target[..., 0],
        )
        for mask in (None, torch.ones(12, 13, dtype=torch.bool))
    )
    torch.testing.assert_close(plain[kind], masked[kind])


@pytest.mark.parametrize("kind", list(LOSSES))
def test_a_view_without_valid_pixels_has_loss_zero_except_for_the_constant_of_ssim(kind: str) -> None:
    output, camera = make_output(5, 6), make_camera(6, 5)
    mask, target = torch.zeros(5, 6, dtype=torch.bool), torch.rand(5, 6, 3, dtype=torch.float64)
    losses = compute_losses(
        output,
        target,
        mask,
        camera,
        [LossTerm(kind, 1.0)],
        iteration=1,
        depth_kind="mean",
        backend_name="reference",
        silhouette=target[..., 0],
    )
    assert losses[kind].item() == (1.0 if kind == "ssim" else 0.0)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("kind", list(LOSSES))
def test_every_reference_loss_passes_a_float64_gradient_check(kind: str, masked: bool) -> None:
    height, width = 6, 7
    output, camera = make_output(height, width, seed=1), make_camera(width, height)
    g = torch.Generator().manual_seed(2)
    target = torch.rand(height, width, 3, generator=g, dtype=torch.float64)
    mask = torch.rand(height, width, generator=g) < 0.85 if masked else None
    images = {name: image for name, image in vars(output).items() if name != "radii"}
    if kind == "normal_consistency":  # alpha is detached there, which finite differences cannot know
        images["alpha"] = images["alpha"].detach()

    def loss(*values: Tensor) -> Tensor:
        rendered = RenderOutput(**dict(zip(images, values, strict=True)), radii=output.radii)
        terms = [LossTerm(kind, 1.0)]
        return compute_losses(
            rendered,
            target,
            mask,
            camera,
            terms,
            iteration=1,
            depth_kind="mean",
            backend_name="reference",
            silhouette=target[..., 0],
        )[kind]

    assert torch.autograd.gradcheck(loss, tuple(images.values()), atol=1e-7)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_the_official_total_is_the_sum_of_the_weighted_terms_that_have_started(
    backend: str, request: pytest.FixtureRequest
) -> None:
    if backend == "cpu":
        request.getfixturevalue("native")
    output, camera = make_output(12, 15, dtype=torch.float32), make_camera(15, 12)
    target = torch.rand(12, 15, 3)

    def losses(iteration: int) -> dict[str, float]:
        values = compute_losses(
            output, target, None, camera, OFFICIAL, iteration=iteration, depth_kind="mean", backend_name=backend
        )
        return {kind: value.item() for kind, value in values.items()}

    assert list(losses(3000)) == ["l1", "ssim"]  # "active when iteration > start"
    assert list(losses(3001)) == ["l1", "ssim", "distortion"]
    everything = losses(7001)
    assert everything["l1"] == pytest.approx(0.8 * (output.color - target).abs().mean().item(), rel=1e-5)
    assert everything["ssim"] == pytest.approx(0.2 * (1 - reference.ssim(output.color, target).item()), rel=1e-5)
    assert everything["distortion"] == pytest.approx(100 * output.distortion.mean().item(), rel=1e-5)
    nc = reference.normal_consistency(output.normal, output.depth_mean, output.alpha, camera)
    assert everything["normal_consistency"] == pytest.approx(0.05 * nc.item(), rel=1e-5)


def test_a_term_that_names_its_depth_overrides_the_protocol() -> None:
    output, camera, target = make_output(8, 9), make_camera(9, 8), torch.zeros(8, 9, 3, dtype=torch.float64)

    def value(term: LossTerm, depth_kind: str) -> float:
        args = (output, target, None, camera, [term])
        losses = compute_losses(*args, iteration=1, depth_kind=depth_kind, backend_name="reference")
        return losses["normal_consistency"].item()

    plain = LossTerm("normal_consistency", 1.0)
    assert value(plain, "mean") != value(plain, "median")
    assert value(LossTerm("normal_consistency", 1.0, depth="median"), "mean") == value(plain, "median")


def test_terms_of_one_kind_add_up() -> None:
    output, camera, target = make_output(8, 9), make_camera(9, 8), torch.zeros(8, 9, 3, dtype=torch.float64)
    args = (output, target, None, camera)
    one, two = (
        compute_losses(*args, [LossTerm("l1", 0.5)] * n, iteration=1, depth_kind="mean", backend_name="reference")
        for n in (1, 2)
    )
    assert two["l1"].item() == pytest.approx(2 * one["l1"].item())


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"backend_name": "auto"}, BackendError, "cpu"),
        ({"terms": [LossTerm("l2", 1.0)]}, RecipeError, "l2"),
        ({"terms": [LossTerm("distortion", None)]}, RecipeError, "no weight"),
        ({"target": torch.zeros(8, 8, 3)}, ShapeError, "target"),
        ({"mask": torch.ones(9, 8, dtype=torch.bool)}, ShapeError, "mask"),
        ({"camera": make_camera(8, 9)}, ShapeError, "camera is 8x9"),
    ],
)
def test_a_wrong_argument_is_refused_in_one_line(change: dict[str, object], error: type[Exception], words: str) -> None:
    arguments: dict[str, object] = {
        "output": make_output(8, 9),
        "target": torch.zeros(8, 9, 3, dtype=torch.float64),
        "mask": None,
        "camera": make_camera(9, 8),
        "terms": [LossTerm("l1", 1.0)],
        "iteration": 1,
        "depth_kind": "mean",
        "backend_name": "reference",
    }
    call: Callable[..., object] = compute_losses
    with pytest.raises(error, match=words) as caught:
        call(**(arguments | change))
    assert "\n" not in str(caught.value)


def test_a_cache_of_another_target_is_refused(native: None) -> None:
    output, camera = make_output(8, 9, dtype=torch.float32), make_camera(9, 8)
    target, other = torch.rand(8, 9, 3), torch.rand(8, 9, 3)

    def ssim(of: Tensor | None) -> float:
        terms = [LossTerm("ssim", 1.0)]
        losses = compute_losses(
            output,
            target,
            None,
            camera,
            terms,
            iteration=1,
            depth_kind="mean",
            backend_name="cpu",
            target_cache=maps[of],
        )
        return losses["ssim"].item()

    maps = {target: target_maps(target), other: target_maps(other), None: None}
    assert ssim(target) == ssim(None)
    with pytest.raises(ShapeError, match="another target"):
        ssim(other)
    target.mul_(0.5)
    with pytest.raises(ShapeError, match="changed in place"):
        ssim(target)


def test_both_implementations_know_the_same_kinds() -> None:
    assert list(LOSSES) == list(FUSED_LOSSES)


def test_the_silhouette_loss_sees_a_splat_that_has_the_colour_of_the_background() -> None:
    # Two empty pixels and two of the object; alpha 0.5 on one empty pixel: |0.5 - 0| / 4 = 0.125.
    alpha = torch.tensor([[0.5, 0.0], [1.0, 1.0]], requires_grad=True)
    wanted = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
    value = reference.silhouette(alpha, wanted)
    assert value.item() == 0.125
    assert torch.autograd.grad(value, alpha)[0].tolist() == [[0.25, 0.0], [0.0, 0.0]]
    # Ignoring that pixel leaves nothing wrong among the other three.
    assert reference.silhouette(alpha, wanted, torch.tensor([[False, True], [True, True]])).item() == 0.0


def test_a_silhouette_term_without_an_alpha_channel_says_so() -> None:
    output, camera = make_output(5, 6), make_camera(6, 5)
    term = [LossTerm("silhouette", 0.1)]
    with pytest.raises(RecipeError, match="alpha channel, got one without"):
        compute_losses(
            output, torch.rand(5, 6, 3), None, camera, term, iteration=1, depth_kind="mean", backend_name="reference"
        )
