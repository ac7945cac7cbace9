"""Training one scene in several processes: batch gradients, identical states, resuming, error messages."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from gs2d.config.densify import Densify
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import LearningRates, Recipe, Stage
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.render.reference_backend import PLAIN
from gs2d.training.densify.densifier import Densifier
from gs2d.training.optimizer import adam_step
from gs2d.training.parallel import ONE_PROCESS
from gs2d.training.state import Moments, TrainState
from gs2d.training.trainer import Trainer, TrainerOptions
from together import RECIPES, Batch, flat, together_in, trained
from train_toys import random_splats, short

CASES = [*RECIPES, "resumed", "differing"]


def differing(a: Any, b: Any) -> list[str]:
    """Return the paths at which two states are not bit-identical."""
    first, second = flat(a), flat(b)
    assert first.keys() == second.keys()
    return [name for name in first if not torch.equal(first[name], second[name])]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """Run all cases in two processes."""
    return together_in(2, CASES, tmp_path_factory.mktemp("two"))


@pytest.mark.parametrize("case", RECIPES)
def test_two_processes_have_identical_states(case: str, two: dict[str, list[Any]]) -> None:
    first, second = two[case]
    assert differing(first["state"], second["state"]) == []


@pytest.mark.parametrize("case", RECIPES)
def test_two_processes_equal_one_with_batches_of_two(case: str, two: dict[str, list[Any]]) -> None:
    """Bit-identical, because a sum of two numbers has no order. Sums over all views (E_i, errors) are rounded."""
    state, heard = trained(RECIPES[case](), Batch(2))
    found = two[case][0]
    assert differing(state.state_dict(), found["state"]) == []
    assert [at[:2] for at in heard["losses"]] == [at[:2] for at in found["losses"]]
    for (*_, losses, lr), (*_, others, other_lr) in zip(heard["losses"], found["losses"], strict=True):
        assert others == pytest.approx(losses)
        assert other_lr == lr


def test_a_run_of_two_processes_resumes_to_the_same_bytes(two: dict[str, list[Any]]) -> None:
    for found in two["resumed"]:
        assert found["at"] == (0, 7)
        assert differing(found["state"], found["whole"]) == []


def test_processes_whose_states_differ_stop_with_one_line(two: dict[str, list[Any]]) -> None:
    for line in two["differing"]:
        assert line.startswith("the states of processes 0 and 1 differ at iteration 4 of stage 1;")
        assert "--resume" in line
        assert "\n" not in line


@pytest.mark.slow
def test_four_processes_equal_one_with_batches_of_four(tmp_path: Path) -> None:
    """Equal up to rounding, because sums of four numbers depend on the order. Smaller batches leave processes idle."""
    cases = ["short", "learning", "cached"]
    for case, found in together_in(4, cases, tmp_path).items():
        state, _ = trained(RECIPES[case](), Batch(4))
        for other in found:
            assert differing(found[0]["state"], other["state"]) == []
        mine, theirs = flat(state.state_dict()), flat(found[0]["state"])
        assert mine.keys() == theirs.keys()
        for name, tensor in mine.items():
            if name.startswith("/splats"):
                torch.testing.assert_close(theirs[name], tensor, rtol=1e-3, atol=1e-4)
            elif not tensor.is_floating_point():
                assert torch.equal(theirs[name], tensor), name


def test_each_view_of_an_iteration_updates_its_learned_rows(two: dict[str, list[Any]]) -> None:
    """19 iterations over six views, in pairs and alone: each view counts exactly once."""
    state = two["learning"][0]["state"]
    assert state["processes"] == [[0, 0, 2]]
    assert sum(state["learned"]["exposure"]["steps"]) == 17  # starting with the third
    assert sum(state["learned"]["poses"]["steps"]) >= 8
    assert state["moments"]["means"]["steps"] <= 5  # the last stage has five views


def test_rates_for_several_views_follow_grendel() -> None:
    rates = LearningRates().for_views(4)
    assert rates.means == pytest.approx(2 * 1.6e-4)
    assert rates.shN == pytest.approx(2 * 2.5e-3 / 20)
    assert (rates.beta1, rates.beta2, rates.eps) == pytest.approx((0.9**4, 0.999**4, 0.5e-15))
    assert rates.means_decay_steps == LearningRates().means_decay_steps
    assert LearningRates(view_power=0).for_views(4).sh0 == LearningRates().sh0
    assert LearningRates().for_views(1) == LearningRates()


def test_a_step_of_four_views_keeps_the_memory_of_four_steps() -> None:
    """Compared with the formulas in float64, after steps of one and of four views: bias correction counts views."""
    stage = Stage("s", 9, train={"opacity_logits": "all"})
    state = TrainState(random_splats(5, dtype=torch.float64), torch.Generator())
    state.moments["opacity_logits"] = Moments.zeros_like(state.splats.opacity_logits)
    expected, seen = state.splats.opacity_logits.clone(), 0
    mean, square = torch.zeros(2, 5, dtype=torch.float64)
    for views in (1, 4, 3):
        gradient = torch.linspace(-1, 2, 5, dtype=torch.float64) / views
        adam_step(state, stage, {"opacity_logits": gradient}, {"opacity_logits": 0.05}, backend=PLAIN, views=views)
        seen += views
        mean = 0.9**views * mean + (1 - 0.9**views) * gradient
        square = 0.999**views * square + (1 - 0.999**views) * gradient**2
        root = (square / (1 - 0.999**seen)).sqrt() + 1e-15 / math.sqrt(views)
        expected = expected - 0.05 / (1 - 0.9**seen) * mean / root
    assert state.moments["opacity_logits"].steps == seen == 8
    torch.testing.assert_close(
        state.splats.opacity_logits, expected, rtol=1e-8, atol=1e-8
    )  # torch counts steps in float32


def test_a_run_resumes_with_another_number_of_processes(scene: Scene) -> None:
    """With 2, then 1, then 2 processes: the schedule counts views, and each view occurs once."""
    _, heard = trained(short(), Batch(2))
    state, heard = trained(short(), ONE_PROCESS, heard["states"][1])
    assert heard["losses"][0][:2] == ("surface", 5)
    state, heard = trained(short(), Batch(2), heard["states"][2])
    assert state.processes == [(0, 0, 2), (0, 4, 1), (0, 7, 2)]
    assert [at[:2] for at in heard["losses"]][:3] == [("surface", 9), ("surface", 10), ("appearance", 2)]
    assert state.stage == 3


class Guest(Densifier):
    """A third-party densifier that assumes one view per iteration."""

    def changes(self, iteration: int) -> bool:
        return False


class Restless(Densifier):
    """A densifier that may change splats in every iteration."""

    shares_views = True


@pytest.mark.parametrize(("guest", "says"), [(Guest, "shares_views"), (Restless, "Densifier.changes")])
def test_densifiers_that_cannot_share_an_iteration_are_refused(
    guest: type[Densifier], says: str, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gs2d.training.trainer.densifier_of", lambda densify, around: densify and guest(around))
    recipe = Recipe("guest", (replace(short().stages[0], densify=Densify("gradient")),))
    with pytest.raises(RecipeError, match=says):
        Trainer(scene, recipe, GENERIC, backend="reference", options=TrainerOptions(processes=Batch(2)))
    Trainer(scene, recipe, GENERIC, backend="reference")
