"""Adam: agreement with torch, row groups, and frozen rows."""

from __future__ import annotations

import math

import pytest
import torch

from gs2d.config.recipe import LearningRates, Stage
from gs2d.core.splats import ATTRIBUTES
from gs2d.training.optimizer import adam_step, begin_stage, lr_at
from gs2d.training.state import TrainState
from train_toys import full_state, random_splats

LR = dict(zip(ATTRIBUTES, (1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 6e-3), strict=True))


def fresh_state(count: int = 9) -> TrainState:
    return TrainState(random_splats(count), torch.Generator().manual_seed(0))


def gradients(state: TrainState, seed: int) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {name: torch.randn(tensor.shape, generator=g) for name, tensor in state.splats.items()}


def test_twenty_steps_equal_torch_adam() -> None:
    state, stage = fresh_state(), Stage("s", 20)
    begin_stage(state, stage)
    mirror = {name: tensor.clone().requires_grad_() for name, tensor in state.splats.items()}
    torch_adam = torch.optim.Adam(
        [{"params": [mirror[name]], "lr": LR[name]} for name in ATTRIBUTES], eps=1e-15, foreach=False
    )
    for i in range(20):
        grads = gradients(state, i)
        adam_step(state, stage, grads, LR)
        for name in ATTRIBUTES:
            mirror[name].grad = grads[name]
        torch_adam.step()
    for name, tensor in state.splats.items():
        torch.testing.assert_close(tensor, mirror[name].detach(), rtol=1e-5, atol=1e-6)
        assert state.moments[name].steps == 20


def test_untrained_rows_and_attributes_keep_their_bits() -> None:
    state = fresh_state()
    state.groups["g"] = torch.tensor([0, 1, 0, 0, 1, 0, 0, 1, 0], dtype=torch.bool)
    before = state.splats.clone()
    stage = Stage("s", 5, train={"sh0": "g", "means": "all"})
    begin_stage(state, stage)
    for i in range(5):
        adam_step(state, stage, gradients(state, i), LR)
    for name, tensor in state.splats.items():
        changed = (
            (tensor != dict(before.items())[name]).flatten(1).any(dim=1)
            if tensor.dim() > 1
            else tensor != before.opacity_logits
        )
        expected = {"sh0": state.groups["g"], "means": torch.ones(9, dtype=torch.bool)}
        assert torch.equal(changed, expected.get(name, torch.zeros(9, dtype=torch.bool))), name
    assert set(state.moments) == {"sh0", "means"}
    assert not state.moments["sh0"].mean[~state.groups["g"]].any()


def test_a_skipped_attribute_keeps_its_bits_and_its_count() -> None:
    state, stage = fresh_state(), Stage("s", 1)
    begin_stage(state, stage)
    before = state.splats.clone()
    adam_step(state, stage, gradients(state, 0), LR, skip=("opacity_logits",))
    assert torch.equal(state.splats.opacity_logits, before.opacity_logits)
    assert state.moments["opacity_logits"].steps == 0
    assert not torch.equal(state.splats.means, before.means)


def test_fresh_moments_are_zero_and_kept_ones_are_kept() -> None:
    state = full_state()
    mean = state.moments["means"].mean
    begin_stage(state, Stage("s", 1, moments="kept"))
    assert state.moments["means"].mean is mean
    assert state.moments["means"].steps == 7
    begin_stage(state, Stage("s", 1, train={"means": "all"}))
    assert set(state.moments) == {"means"}
    assert not state.moments["means"].mean.any()
    assert state.moments["means"].steps == 0


def test_rates_decay_only_for_the_means_which_scale_with_the_extent() -> None:
    first, last = lr_at(LearningRates(), 0, 2.0), lr_at(LearningRates(), 30_000, 2.0)
    assert first["means"] == pytest.approx(3.2e-4)
    assert last["means"] == pytest.approx(3.2e-6)
    assert lr_at(LearningRates(), 15_000, 2.0)["means"] == pytest.approx(2 * math.sqrt(1.6e-4 * 1.6e-6))
    assert {k: v for k, v in first.items() if k != "means"} == {k: v for k, v in last.items() if k != "means"}
    assert first["opacity_logits"] == 0.05
