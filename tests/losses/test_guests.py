"""Plug-in losses: a function with options, and a class with its own data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import train_toys
from emulate import Emulator
from fake_backends import cuda_on_host
from gs2d.config.loss_registry import LOSSES, register_loss
from gs2d.config.recipe import LossTerm, Recipe, validate
from gs2d.config.serialize import from_json, to_json
from gs2d.data.scene import Scene, View
from gs2d.errors import RecipeError
from gs2d.kernels.cuda import launch
from gs2d.kernels.library import available_variants
from gs2d.kernels.loss_operations import LossOperations
from gs2d.losses.base import Loss, Losses, LossView, compute_losses
from gs2d.render.backends import get_backend
from gs2d.render.types import RenderOutput
from gs2d.training import events
from loss_images import make_camera, make_output


@pytest.fixture(autouse=True)
def guests() -> Iterator[None]:
    before = {name: LOSSES.get(name) for name in LOSSES.builtin}  # modules register only once
    yield
    LOSSES._objects.clear()
    LOSSES._objects.update(before)


def blackness(output: RenderOutput, view: LossView, power: float = 1.0) -> Tensor:
    """Return the brightness of the image."""
    return output.color.clamp_min(1e-6).pow(power).mean()


class Mean(Loss):
    """Mean colour of each image, computed once."""

    def __init__(self, only: int) -> None:
        self._only = only

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        self._means = [torch.tensor(view.image().mean() / 255, device=device) for view in scene.train]

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        assert view.index is not None
        return (output.color.mean() - self._means[view.index]).square() if view.index == self._only else None


def losses_of(terms: list[LossTerm]) -> dict[str, Tensor]:
    output, camera, target = make_output(5, 6), make_camera(6, 5), torch.rand(5, 6, 3, dtype=torch.float64)
    return compute_losses(output, LossView(target, camera), terms, backend="reference")


def test_a_function_is_a_loss_with_its_options_and_weight() -> None:
    register_loss("blackness")(blackness)
    color = make_output(5, 6).color
    found = losses_of([LossTerm("blackness", 3.0, options={"power": 2.0}), LossTerm("blackness", 1.0)])
    assert found["blackness"].item() == pytest.approx((3 * color.pow(2).mean() + color.mean()).item())


def test_a_recipe_with_a_registered_loss_is_written_and_read() -> None:
    register_loss("blackness")(blackness)
    recipe = train_toys.short()
    first = replace(recipe.stages[0], losses=(LossTerm("blackness", 3.0, options={"power": 2.0}),))
    made = validate(replace(recipe, stages=(first, *recipe.stages[1:])))
    assert from_json(to_json(made)) == made


def test_a_loss_class_is_prepared_and_may_skip_views() -> None:
    register_loss("mean")(Mean)
    recipe, scene = train_toys.short(), train_toys.make_scene()
    stage = replace(recipe.stages[0], losses=(*recipe.stages[0].losses, LossTerm("mean", 1.0, options={"only": 1})))
    _, recorder = train_toys.train(scene, replace(recipe, stages=(stage,)))
    told = [event.losses for event in recorder.events if isinstance(event, events.Progress)]
    assert sum("mean" in losses for losses in told) == pytest.approx(len(told) / len(scene.train), abs=1)


@pytest.mark.parametrize("kind", ["depth_prior", "normal_prior"])
def test_losses_on_prior_maps_load_their_data(kind: str) -> None:
    with pytest.raises(RecipeError, match=f"loss '{kind}' must be prepared for a scene"):
        losses_of([LossTerm(kind, 0.1)])


def test_options_that_a_loss_does_not_take_stop_before_training() -> None:
    register_loss("mean")(Mean)
    recipe = train_toys.short()
    stage = replace(recipe.stages[0], losses=(*recipe.stages[0].losses, LossTerm("mean", 1.0)))
    with pytest.raises(RecipeError, match="loss 'mean' does not take the options {}: .*only"):
        train_toys.train(train_toys.make_scene(), replace(recipe, stages=(stage,)))
    with pytest.raises(RecipeError, match="loss 'mean' must be prepared for a scene"):
        losses_of([LossTerm("mean", 1.0, options={"only": 1})])


def transparent(scene: Scene) -> Scene:
    """Add an alpha channel to the images of a scene."""
    views = []
    for view in scene.train:
        alpha = np.full((*view.image().shape[:2], 1), 255, np.uint8)
        alpha[:9] = 0
        views.append(View.from_arrays(view.name, view.camera, np.concatenate([view.image(), alpha], axis=2)))
    return replace(scene, train=tuple(views))


def with_guest(recipe: Recipe, *, needs: Sequence[str]) -> tuple[Recipe, list[tuple[RenderOutput, LossView]]]:
    """Return a recipe whose first stage has a loss with these needs, and a list that records its arguments."""
    given: list[tuple[RenderOutput, LossView]] = []

    def kept(output: RenderOutput, view: LossView) -> Tensor:
        given.append((output, view))
        return output.alpha.mean()

    register_loss("kept", needs=needs)(kept)
    stage = replace(recipe.stages[0], losses=(*recipe.stages[0].losses, LossTerm("kept", 0.1)))
    return replace(recipe, stages=(stage,)), given


@pytest.mark.parametrize("name", ["cpu", "reference", "cuda"])
def test_a_loss_gets_the_silhouette_and_the_distortion_that_it_needs(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "cuda":
        emulator = Emulator()
        monkeypatch.setattr(launch, "launcher_for", lambda device: emulator)
    elif name == "cpu" and not available_variants():
        pytest.skip("the native library is not built")
    backend = cuda_on_host() if name == "cuda" else get_backend(name)
    recipe, given = with_guest(train_toys.short(), needs=["silhouette", "distortion"])
    train_toys.train(transparent(train_toys.make_scene()), recipe, backend=backend)
    assert given
    for output, view in given:
        assert view.silhouette is not None
        assert view.silhouette[:9].max() == 0
        assert view.silhouette[9:].min() == 1
        assert output.distortion.isfinite().all()


@pytest.mark.parametrize("needs", [["depth"], "silhouette"])
def test_an_unknown_need_is_refused(needs: Sequence[str]) -> None:
    with pytest.raises(RecipeError, match="needs of loss 'kept' must be a list of silhouette, flatness"):
        register_loss("kept", needs=needs)


def test_a_class_must_be_a_loss() -> None:
    register_loss("bare")(type("Bare", (), {}))
    with pytest.raises(RecipeError, match="loss 'bare' must be a function or a subclass of gs2d.losses.base.Loss"):
        losses_of([LossTerm("bare", 1.0)])


class Fused(Loss):
    """Mean colour, with implementations for fused backends and for fused iterations."""

    only_color = True

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor:
        return output.color.mean()

    def fused(self, output: RenderOutput, view: LossView, operations: LossOperations) -> Tensor:
        return operations.masked_mean(output.color.mean(dim=2), view.mask)

    def in_step(self, term: LossTerm, *, opaque: bool) -> dict[str, float]:
        return {"l1": 1.0}


def test_a_registered_loss_may_be_fused_and_use_cached_views(native: None) -> None:
    register_loss("own")(Fused)
    term = LossTerm("own", 1.0)
    view, output = LossView(torch.rand(5, 6, 3), make_camera(6, 5)), make_output(5, 6, dtype=torch.float32)
    found, plain = (compute_losses(output, view, [term], backend=name)["own"] for name in ("cpu", "reference"))
    assert found.item() == pytest.approx(plain.item(), rel=1e-6)
    assert type(found.grad_fn.next_functions[0][0]).__name__ != "MeanBackward0"
    assert Losses([term])[term].only_color
