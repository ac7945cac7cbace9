"""Losses of a recipe: masks, gradients, terms, both implementations."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from gs2d.config.loss_registry import LOSSES
from gs2d.config.recipe import DepthPrior, LossTerm, NormalPrior, Recipe, Stage
from gs2d.core.camera import Camera
from gs2d.errors import BackendError, RecipeError, ShapeError
from gs2d.losses import formulas as reference
from gs2d.losses.base import Losses, LossView, compute_losses, losses_of
from gs2d.losses.prior_formulas import MetricDepth, NormalTarget
from gs2d.render.types import RenderOutput
from loss_images import make_camera, make_output

KINDS = LOSSES.builtin
PRIORS = ("depth_prior", "normal_prior")
OFFICIAL = (
    LossTerm("l1", 0.8),
    LossTerm("ssim", 0.2),
    LossTerm("normal_consistency", 0.05, start=7000),
    LossTerm("distortion", 100.0, start=3000),
)


def one_loss(
    kind: str,
    output: RenderOutput,
    target: Tensor,
    mask: Tensor | None,
    camera: Camera,
    *,
    depth: str = "mean",
    backend: str = "reference",
) -> Tensor:
    """Return a loss of weight 1; the silhouette is the first channel of the target."""
    terms = [LossTerm(kind, 1.0)]
    of_image = {"silhouette": target[..., 0], "flatness": (255 * target[..., 1]).to(torch.uint8)}
    view = LossView(target, camera, mask, index=0, depth_kind=depth, **of_image)
    losses = Losses(terms)
    if kind in PRIORS:
        losses[terms[0]]._priors = OnePrior(target)  # type: ignore[attr-defined]
        losses[terms[0]]._prior = NormalPrior()  # type: ignore[attr-defined]
    return compute_losses(output, view, terms, backend=backend, losses=losses)[kind]


@pytest.fixture(params=["reference", "cpu"])
def backend(request: pytest.FixtureRequest) -> str:
    if request.param == "cpu":
        request.getfixturevalue("native")
    return str(request.param)


class OnePrior:
    """Depths and normals computed from a target's colours, with the interface of ``Priors``."""

    def __init__(self, target: Tensor) -> None:
        valid, directions = torch.ones_like(target[..., 0]), torch.nn.functional.normalize(target, dim=2)
        self._known = MetricDepth(0.5 + target[..., 1], valid > 0), NormalTarget(directions, valid)

    def at(self, *_: object) -> tuple[MetricDepth, NormalTarget]:
        return self._known


@pytest.mark.parametrize("kind", KINDS)
def test_ignored_pixels_have_no_influence(kind: str, backend: str) -> None:
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
            if image is not None and name not in ("radii", "normal_without_pose_grad")
        }
        output = RenderOutput(**leaves, radii=clean.radii)
        loss = one_loss(kind, output, target, mask, camera, backend=backend)
        values.append(loss.item())
        found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
        gradients.append([g for g in found if g is not None])
    assert values[0] == values[1] == values[2]
    assert gradients[0]
    for first, *others in zip(*gradients, strict=True):
        assert first.abs().sum() > 0
        assert (first[~mask] == 0).all()
        for other in others:
            assert torch.equal(first, other)


@pytest.mark.parametrize("kind", KINDS)
def test_an_all_true_mask_changes_nothing(kind: str) -> None:
    output, camera, target = make_output(12, 13), make_camera(13, 12), torch.rand(12, 13, 3, dtype=torch.float64)
    plain, masked = (
        one_loss(kind, output, target, mask, camera, depth="median")
        for mask in (None, torch.ones(12, 13, dtype=torch.bool))
    )
    torch.testing.assert_close(plain, masked)


@pytest.mark.parametrize("kind", KINDS)
def test_a_view_without_valid_pixels_has_loss_zero_except_for_the_constant_of_ssim(kind: str) -> None:
    output, camera = make_output(5, 6), make_camera(6, 5)
    mask, target = torch.zeros(5, 6, dtype=torch.bool), torch.rand(5, 6, 3, dtype=torch.float64)
    assert one_loss(kind, output, target, mask, camera).item() == (1.0 if kind == "ssim" else 0.0)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_every_reference_loss_passes_a_float64_gradient_check(kind: str, masked: bool) -> None:
    height, width = 6, 7
    output, camera = make_output(height, width, seed=1), make_camera(width, height)
    g = torch.Generator().manual_seed(2)
    target = torch.rand(height, width, 3, generator=g, dtype=torch.float64)
    mask = torch.rand(height, width, generator=g) < 0.85 if masked else None
    images = {name: image for name, image in vars(output).items() if name not in ("radii", "normal_without_pose_grad")}
    if kind in ("normal_consistency", *PRIORS):  # alpha is detached, which finite differences cannot reproduce
        images["alpha"] = images["alpha"].detach()

    def loss(*values: Tensor) -> Tensor:
        rendered = RenderOutput(**dict(zip(images, values, strict=True)), radii=output.radii)
        return one_loss(kind, rendered, target, mask, camera)

    assert torch.autograd.gradcheck(loss, tuple(images.values()), atol=1e-7)


def test_the_official_total_is_the_sum_of_the_weighted_terms_that_have_started(backend: str) -> None:
    output, camera = make_output(12, 15, dtype=torch.float32), make_camera(15, 12)
    target = torch.rand(12, 15, 3)

    def losses(iteration: int) -> dict[str, float]:
        values = compute_losses(output, LossView(target, camera, iteration=iteration), OFFICIAL, backend=backend)
        return {kind: value.item() for kind, value in values.items()}

    assert list(losses(3000)) == ["l1", "ssim"]  # "active when iteration > start"
    assert list(losses(3001)) == ["l1", "ssim", "distortion"]
    everything = losses(7001)
    assert everything["l1"] == pytest.approx(0.8 * (output.color - target).abs().mean().item(), rel=1e-5)
    assert everything["ssim"] == pytest.approx(0.2 * (1 - reference.ssim(output.color, target).item()), rel=1e-5)
    assert everything["distortion"] == pytest.approx(100 * output.distortion.mean().item(), rel=1e-5)
    nc = reference.normal_consistency(output.normal, output.depth_mean, output.alpha, camera)
    assert everything["normal_consistency"] == pytest.approx(0.05 * nc.item(), rel=1e-5)


@pytest.mark.parametrize("kind", ["normal_consistency", "normal_consistency_per_splat"])
def test_the_edges_option_sets_normals_beside_empty_pixels(kind: str, backend: str) -> None:
    output, camera, target = make_output(8, 9, dtype=torch.float32), make_camera(9, 8), torch.zeros(8, 9, 3)
    depth = output.depth_mean.detach().clone()
    depth[2:5, 3:6] = 0
    output = replace(output, depth_mean=depth)
    function = partial(reference.normal_consistency, per_splat=kind.endswith("per_splat"))
    for edges in ("undefined", "camera"):
        term = LossTerm(kind, 1.0, options={"edges": edges})
        found = compute_losses(output, LossView(target, camera), [term], backend=backend)
        expected = function(output.normal, depth, output.alpha, camera, edges=edges)
        assert found[kind].item() == pytest.approx(expected.item(), rel=1e-5)
    assert function(output.normal, depth, output.alpha, camera).item() != pytest.approx(expected.item(), rel=1e-3)


def test_normal_consistency_is_heavier_where_the_image_has_no_texture(backend: str) -> None:
    output, camera = make_output(8, 24, dtype=torch.float32), make_camera(24, 8)
    target = torch.full((8, 24, 3), 0.5)
    target[:, 12:] = torch.rand(8, 12, 1, generator=torch.Generator().manual_seed(1))
    gradients = []
    for flat in (1.0, 6.0):
        terms = [LossTerm("normal_consistency", 1.0, options={"flat": flat})]
        value = compute_losses(output, LossView(target, camera), terms, backend=backend)["normal_consistency"]
        gradients += torch.autograd.grad(value, output.normal)
    plain, heavier = (gradient[1:-1, 1:-1] for gradient in gradients)
    torch.testing.assert_close(heavier[:, :7], 6 * plain[:, :7])
    torch.testing.assert_close(heavier[:, 14:], plain[:, 14:], rtol=0.05, atol=0.0)


def test_object_weights_give_no_gradient_to_the_background(backend: str) -> None:
    output, camera, target = make_output(8, 9, dtype=torch.float32), make_camera(9, 8), torch.zeros(8, 9, 3)
    alpha = torch.zeros(8, 9)
    alpha[2:6, 3:7] = 1
    gradients = {}
    for where in ("image", "object"):
        terms = [LossTerm("normal_consistency", 1.0, options={"where": where})]
        view = LossView(target, camera, silhouette=alpha)
        value = compute_losses(output, view, terms, backend=backend)["normal_consistency"]
        (gradients[where],) = torch.autograd.grad(value, output.normal)
    empty = alpha[1:-1, 1:-1] == 0  # among pixels with a normal
    inner = {where: gradient[1:-1, 1:-1] for where, gradient in gradients.items()}
    assert (inner["image"][empty] != 0).all()
    assert (inner["object"][empty] == 0).all()
    torch.testing.assert_close(inner["object"][~empty], inner["image"][~empty])


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"backend": "metal"}, BackendError, "cpu"),
        ({"terms": [LossTerm("distortion", None)]}, RecipeError, "no weight"),
        ({"target": torch.zeros(8, 8, 3)}, ShapeError, "target"),
        ({"mask": torch.ones(9, 8, dtype=torch.bool)}, ShapeError, "mask"),
        ({"camera": make_camera(8, 9)}, ShapeError, "camera is 8x9"),
    ],
)
def test_a_wrong_argument_is_refused_in_one_line(change: dict[str, object], error: type[Exception], words: str) -> None:
    view: dict[str, Any] = {"target": torch.zeros(8, 9, 3, dtype=torch.float64), "camera": make_camera(9, 8)}
    choices: dict[str, Any] = {"terms": [LossTerm("l1", 1.0)], "backend": "reference"}
    for name, value in change.items():
        (choices if name in choices else view)[name] = value
    with pytest.raises(error, match=words) as caught:
        compute_losses(make_output(8, 9), LossView(**view), **choices)
    assert "\n" not in str(caught.value)


def test_a_required_silhouette_needs_an_alpha_channel() -> None:
    output, camera, alpha = make_output(5, 6), make_camera(6, 5), torch.rand(5, 6)
    view = LossView(torch.rand(5, 6, 3), camera)
    with pytest.raises(RecipeError, match="alpha channel, got one without"):
        compute_losses(output, view, [LossTerm("silhouette", 0.1)], backend="reference")
    terms = [LossTerm("l1", 1.0), LossTerm("silhouette", 0.1, options={"required": False})]
    assert set(compute_losses(output, view, terms, backend="reference")) == {"l1"}
    found = compute_losses(output, replace(view, silhouette=alpha), terms, backend="reference")
    torch.testing.assert_close(found["silhouette"], 0.1 * (output.alpha - alpha).abs().mean())


def trained_with(*terms: LossTerm, **settings: Any) -> Recipe:
    return Recipe("r", (Stage("s", 1, losses=(LossTerm("l1", 1.0), *terms)),), **settings)


@pytest.mark.parametrize(
    ("term", "words"),
    [
        (
            LossTerm("ssim", 1.0, options={"where": "object"}),
            "loss 'ssim' does not take the options {'where': 'object'",
        ),
        (
            LossTerm("normal_consistency", 1.0, options={"edges": "centre"}),
            "loss 'normal_consistency': edges must be one of undefined, camera; got 'centre'",
        ),
        (
            LossTerm("normal_consistency", 1.0, options={"flat": 0.0}),
            "option flat of normal consistency must be a positive number, got 0.0",
        ),
        (
            LossTerm("normal_consistency_per_splat", 1.0, options={"where": "alpha"}),
            "loss 'normal_consistency_per_splat': where must be one of image, object; got 'alpha'",
        ),
        (LossTerm("silhouette", 1.0, options={"required": "no"}), "required must be true or false, got 'no'"),
    ],
)
def test_each_loss_checks_its_options(term: LossTerm, words: str) -> None:
    with pytest.raises(RecipeError) as caught:
        losses_of(trained_with(term))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["depth_prior", "normal_prior"])
def test_a_loss_and_its_settings_are_required_together(kind: str) -> None:
    settings = {"depth_prior": DepthPrior(), "normal_prior": NormalPrior()}
    with pytest.raises(RecipeError, match=f"{kind} is null, but loss '{kind}' needs it"):
        losses_of(trained_with(LossTerm(kind, 0.1)))
    with pytest.raises(RecipeError, match=f"{kind} is set, but no loss uses it"):
        losses_of(trained_with(**{kind: settings[kind]}))
    assert losses_of(trained_with(LossTerm(kind, 0.1), **{kind: settings[kind]}))
