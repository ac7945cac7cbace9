"""Relocation: what several discs in one place look like, who goes where, the budget, resume to the same bytes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gs2d.config.densify import Densify
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import Recipe
from gs2d.core.transforms import quats_to_matrices
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.training import events
from gs2d.training.densify.relocation import MAX_COPIES, Relocation, shared
from gs2d.training.trainer import Trainer
from saved_states import resumed_everywhere
from train_toys import short

EVERY = {"start": 0, "stop": 10, "rounds": 5}  # rounds at 2, 4, 6, 8 and 10


def relocating(**options: object) -> Recipe:
    recipe = short()
    first = replace(recipe.stages[0], densify=Densify("relocation", {"max_splats": 70, **EVERY, **options}))
    return replace(recipe, stages=(first, *recipe.stages[1:]))


def entered(scene: Scene, **options: object) -> Trainer:
    trainer = Trainer(scene, relocating(**options), GENERIC, backend="reference")
    trainer.enter(0)
    return trainer


def test_two_discs_share_an_opacity_of_three_quarters_by_hand() -> None:
    # Each transmits sqrt(1/4): opacity 1/2. Together they cover 1/2 + (1 - 1/4) / 2 = 7/8 of what discs of their size
    # and opacity 1 would, the one covered 3/4: their area is 6/7 of its.
    logits, log_scales = shared(torch.tensor([math.log(3.0)]), torch.tensor([[0.5, -0.5]]), torch.tensor([2]))
    assert logits.item() == pytest.approx(0.0, abs=1e-6)
    assert (log_scales - torch.tensor([[0.5, -0.5]])).exp().square()[0].tolist() == pytest.approx([6 / 7] * 2)


@pytest.mark.parametrize("count", [1, 2, 3, 10, MAX_COPIES + 1])
@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
def test_discs_that_share_a_place_cover_what_the_one_did(count: int, opacity: float) -> None:
    logit = torch.tensor([math.log(opacity / (1 - opacity))], dtype=torch.float64)
    logits, log_scales = shared(logit, torch.zeros(1, 2, dtype=torch.float64), torch.tensor([count]))
    r = torch.linspace(0, 12, 200_001, dtype=torch.float64)  # integrals over the plane, by rings

    def covered(o: Tensor, s: float, times: int) -> Tensor:
        return torch.trapezoid((1 - (1 - o * torch.exp(-0.5 * (r / s) ** 2)) ** times) * r, r)

    one = covered(torch.tensor(opacity, dtype=torch.float64), 1.0, 1)
    several = covered(torch.sigmoid(logits[0]), float(log_scales[0, 0].exp()), count)
    assert several.item() == pytest.approx(one.item(), rel=1e-6)
    centre = 1 - (1 - torch.sigmoid(logits[0])) ** count
    assert centre.item() == pytest.approx(opacity)


def test_rounds_are_even_and_the_budget_is_reached_when_growing_ends() -> None:
    options = Relocation(max_splats=1000, start=100, stop=1100, rounds=4, growing=0.5)
    assert [i for i in range(1, 2000) if options.round_at(i)] == [350, 600, 850, 1100]
    assert [options.round_at(i) for i in (350, 600, 850, 1100)] == [1, 2, 3, 4]
    # two of four rounds grow: half of what is left, then all of it
    assert options.added(200, 1) == 400
    assert options.added(600, 2) == 400
    assert options.added(990, 4) == 10
    assert options.added(1200, 1) == 0
    many = Relocation(max_splats=10, start=0, stop=3, rounds=100)
    assert [i for i in range(1, 9) if many.round_at(i)] == [1, 2, 3]


def test_the_faint_and_the_large_move_onto_others_and_n_grows_to_the_budget(scene: Scene) -> None:
    trainer = entered(scene, noise=0.0, dead_opacity=0.02, scale_cull=2.0)
    state, before = trainer.state, len(trainer.splats)
    trainer.step()
    state.splats.opacity_logits[:7] = -5.0  # 0.0067
    state.splats.log_scales[7, 1] = math.log(2.1 * scene.extent)
    happened: list[events.Event] = []
    trainer._on_event = happened.append
    alive = state.splats.means[8:].clone()
    trainer.step()
    (event,) = (event for event in happened if isinstance(event, events.Densified))
    # rounds 1 and 2 of 5 grow (ceil(0.5 * 5) = 3 of them): a third of the room to 70 first
    grown = (70 - before) // 3
    assert (event.pruned_by_opacity, event.pruned_large, event.cloned) == (7, 1, 8 + grown)
    assert event.splats == len(state.splats) == before + grown
    assert torch.equal(state.splats.means[: before - 8], alive)  # Adam waits
    places = {tuple(mean) for mean in alive.tolist()}
    assert all(tuple(mean) in places for mean in state.splats.means[before - 8 :].tolist())
    while state.step < 10:
        trainer.step()
        assert len(state.splats) <= 70
    assert len(state.splats) == 70


def test_the_faint_wander_in_their_plane_and_the_opaque_stay(scene: Scene) -> None:
    trainer = entered(scene, noise=1.0, noise_every=1, rounds=1, dead_opacity=0.0)
    trainer.step()
    splats = trainer.splats
    splats.opacity_logits[:30], splats.opacity_logits[30:] = -9.0, 3.0
    splats.log_scales[:] = math.log(0.1)
    before = splats.means.clone()
    densifier = trainer._densifiers[0]
    densifier._wander(trainer.state, 5)  # type: ignore[union-attr]
    offsets = (quats_to_matrices(splats.quats).transpose(1, 2) @ (splats.means - before)[:, :, None])[:, :, 0]
    assert offsets[:, 2].abs().max() < 1e-6
    assert offsets[30:].abs().max() < 1e-6
    # half of the way to stop: standard deviation 0.5 x 0.1, of 60 draws known to 9 %
    assert offsets[:30, :2].std().item() == pytest.approx(0.05, rel=0.3)


def test_what_lets_go_is_the_gradient_of_the_mean_opacity_and_the_mean_scale(scene: Scene) -> None:
    trainer = entered(scene, opacity_weight=0.3, scale_weight=0.7)
    plain = {name: torch.zeros_like(t) for name, t in trainer.splats.items()}

    class Output:
        gradients = plain

    trainer._densifiers[0]._let_go(trainer.state, Output)  # type: ignore[union-attr]
    logits = trainer.splats.opacity_logits.clone().requires_grad_()
    log_scales = trainer.splats.log_scales.clone().requires_grad_()
    (0.3 * torch.sigmoid(logits).mean() + 0.7 * log_scales.exp().mean() / scene.extent).backward()
    torch.testing.assert_close(plain["opacity_logits"], logits.grad)
    torch.testing.assert_close(plain["log_scales"], log_scales.grad)


def test_a_run_that_relocates_resumes_to_the_same_bytes(scene: Scene, backend: str) -> None:
    resumed_everywhere(scene, relocating(scatter=0.3, noise_every=3), backend)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_splats": 0}, "densify.options.max_splats"),
        ({"rounds": 0}, "densify.options.rounds"),
        ({"growing": 1.5}, "densify.options.growing"),
        ({"noise": -1.0}, "densify.options.noise"),
        ({"budget": 3}, "relocation"),
    ],
)
def test_wrong_options_are_refused_before_training(scene: Scene, options: dict[str, object], message: str) -> None:
    with pytest.raises(RecipeError) as caught:
        Trainer(scene, relocating(**options), GENERIC, backend="reference")
    assert message in str(caught.value)
