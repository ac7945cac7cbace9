"""Common behaviour of learned quantities: Adam, schedule, cancelled updates, resuming, error messages."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from fake_backends import lacking
from gs2d.config.presets import surface
from gs2d.config.protocols import GENERIC
from gs2d.config.quantities import EXPOSURE, INTRINSICS, POSES, Quantity
from gs2d.config.recipe import Recipe
from gs2d.config.serialize import apply_overrides, from_json, to_json
from gs2d.data.scene import Scene
from gs2d.errors import DivergedError, RecipeError, RunError
from gs2d.training.learned.camera_pose import CameraPose
from gs2d.training.learned.learned_table import LearnedTable
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from learned_rows import Learner, begun
from saved_states import resumed_everywhere
from train_toys import backends, random_splats, same, short

NAMES = ("intrinsics", "poses", "exposure")


def everything(**changes: float) -> Recipe:
    """Return ``short`` with all quantities active from the third iteration on."""
    given = {"start": 2, "decay_steps": 10, "rate": 1e-2, "rate_final": 1e-3, **changes}
    quantities = EXPOSURE, POSES, INTRINSICS.with_options(principal_point=True)
    return short().with_learned(*(replace(quantity, **given) for quantity in quantities))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", NAMES)
def test_the_first_step_of_a_row_is_the_rate_and_the_second_is_adam_s(scene: Scene, name: str) -> None:
    made = Learner(everything(), scene)
    quantity, rows = made.table.quantities[name], made.rows[name]
    row, shape = quantity.row_of[1], quantity.shape
    made.step(name, 1, torch.full(shape, 3.0), 0.1)
    rates = torch.as_tensor(quantity.rates(0.1, 1)).to(rows.values).expand(shape)
    assert torch.allclose(rows.values[row], -rates)
    others = [other for other in range(len(rows)) if other != row]
    assert not rows.values[others].any()
    assert [rows.steps[k] for k in (row, *others)] == [1, *[0] * len(others)]
    made.step(name, 1, torch.full(shape, -1.0), 0.1)
    b1, b2 = quantity.beta1, quantity.beta2
    mean = (b1 * (1 - b1) * 3 - (1 - b1)) / (1 - b1**2)
    square = (b2 * (1 - b2) * 9 + (1 - b2)) / (1 - b2**2)
    assert torch.allclose(rows.values[row], -rates - rates * mean / math.sqrt(square), rtol=1e-5)


def test_rates_decay_over_the_whole_run_after_the_start() -> None:
    settings = replace(POSES, rate=0.1, rate_final=0.001, decay_steps=100, start=5)
    assert settings.rate_at(50) == pytest.approx(0.01)  # the geometric mean, at half of the schedule
    assert settings.rate_at(100) == settings.rate_at(500) == pytest.approx(0.001)
    assert settings.rate_at(5) == 0 < settings.rate_at(6)


def test_poses_are_learned_only_while_all_splats_move(scene: Scene) -> None:
    table = LearnedTable(everything(), scene)
    assert table.learning(0, 2) == {}
    assert set(table.learning(0, 3)) == set(NAMES)
    assert table.learning(0, 3)["poses"] > table.learning(0, 4)["poses"]
    assert set(table.learning(1, 1)) == {"exposure"}  # only colours are trained
    assert table.learning(2, 1) == pytest.approx(dict.fromkeys(NAMES, 1e-3))


@pytest.mark.parametrize("name", NAMES)
def test_a_cancelled_update_changes_nothing(scene: Scene, name: str) -> None:
    made = Learner(everything(), scene)
    made.step(name, 1, torch.ones(made.table.shapes[name]), 0.1, lacking(1))
    made.table.rollback(made.rows, 1, {name: 0.1} if sum(made.rows[name].steps) else {})
    assert not any(made.rows[name].steps)
    assert not made.rows[name].values.any()
    made.step(name, 1, torch.ones(made.table.shapes[name]), 0.1, lacking(0))
    assert sum(made.rows[name].steps) == 1


def test_resuming_from_any_event_gives_the_same_splats_and_rows(scene: Scene) -> None:
    resumed_everywhere(scene, everything(), backends()[-1], every=3 if backends()[-1] == "cpu" else 9)


def test_bytes_do_not_depend_on_the_number_of_threads(scene: Scene) -> None:
    ends, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            trainer = Trainer(scene, everything(), GENERIC, backend=backends()[-1])
            ends.append((trainer.run(), trainer.state.learned))
    finally:
        torch.set_num_threads(before)
    assert same(ends[0][0], ends[1][0])
    assert all(torch.equal(ends[0][1][name].values, ends[1][1][name].values) for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_state_with_wrong_learned_rows_is_refused(scene: Scene, name: str) -> None:
    state = begun(TrainState(random_splats(5), torch.Generator()), everything(), scene)
    rows = state.learned.pop(name)
    with pytest.raises(RunError, match=rf"must have \d rows of '{name}' for this recipe and scene, got 0"):
        Trainer(scene, everything(), GENERIC, backend="reference", state=state)
    state.learned = {name: rows}
    with pytest.raises(RunError, match=rf"must have 0 rows of '{name}' for this recipe and scene, got {len(rows)}"):
        Trainer(scene, short(), GENERIC, backend="reference", state=state)
    rows.values.view(-1)[0] = torch.nan
    with pytest.raises(RunError, match=f"{name} hold NaN or infinity"):
        TrainState.from_state_dict(state.state_dict())
    rows.values, rows.steps = torch.zeros(len(rows), 1, 7, dtype=torch.float64), rows.steps
    with pytest.raises(RunError, match="checkpoint is broken"):
        TrainState.from_state_dict(state.state_dict())


def test_learned_numbers_that_are_not_finite_stop_training(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(scene, everything(start=0), GENERIC, backend=backends()[-1])
    trainer.enter(0)
    monkeypatch.setattr(CameraPose, "gradient", lambda *_: torch.full((6,), torch.nan))
    with pytest.raises(DivergedError, match="the gradient of poses is NaN or infinite"):
        trainer.step()
    trainer.state.learned["exposure"].values[0, 0] = torch.nan
    with pytest.raises(DivergedError, match="learned exposure is NaN or infinite"):
        trainer._check_parameters(trainer.recipe.stages[0], ())


# -- recipe settings -----------------------------------------------------------------------------------------------
def test_a_recipe_names_registered_quantities_once() -> None:
    recipe = Recipe("one", (surface(),))
    with pytest.raises(RecipeError, match=r"quantity must be one of intrinsics, poses.*got 'warmth'"):
        Quantity("warmth")
    twice = replace(recipe, learned=(EXPOSURE, EXPOSURE))
    with pytest.raises(RecipeError, match="learned 'exposure' is there twice"):
        from_json(to_json(twice))
    learning = recipe.with_learned(EXPOSURE, INTRINSICS, POSES)
    assert list(learning.quantities) == ["intrinsics", "poses", "exposure"]  # in the order of application
    changed = apply_overrides(learning, ["learned.exposure.start=7", "learned.intrinsics.options.principal_point=true"])
    assert changed.quantities["exposure"] == replace(EXPOSURE, start=7)
    assert changed.quantities["intrinsics"].options == {"principal_point": True}
