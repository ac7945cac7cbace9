"""Densifiers as plug-in objects: a registered one, its recipe entry, and the training loop's use of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import pytest
import torch

import train_toys
from gs2d.config.densify import DENSIFIERS, Densify, register_densifier
from gs2d.config.recipe import Recipe, validate
from gs2d.config.schedule import scale_schedule
from gs2d.config.serialize import apply_overrides, from_json, to_json
from gs2d.errors import RecipeError
from gs2d.training import events
from gs2d.training.densify.densifier import Densifier, Surroundings
from gs2d.training.rows import append_rows
from gs2d.training.state import TrainState
from gs2d.training.step_result import StepResult
from gs2d.training.trainer import Trainer


class Twins(Densifier):
    """At iteration ``at``, duplicates the splats that were visible most often."""

    def __init__(self, surroundings: Surroundings, at: int, count: int = 2) -> None:
        super().__init__(surroundings)
        self.at, self.count = at, count

    def begin(self, state: TrainState) -> None:
        state.statistics = {"seen": torch.zeros(len(state.splats))}

    def changes(self, iteration: int) -> bool:
        return iteration == self.at

    def after_backward(self, state: TrainState, output: StepResult, iteration: int) -> Sequence[events.TrainingEvent]:
        assert state.statistics is not None
        assert output.radii is not None
        seen = state.statistics["seen"]
        self.surroundings.backend.assign(seen, seen + (output.radii > 0))
        if iteration != self.at:
            return ()
        rows = seen.argsort(descending=True, stable=True)[: self.count]
        append_rows(state, state.splats.rows(rows))
        return (events.Densified(self.surroundings.stage, iteration, self.count, 0, 0, 0, len(state.splats)),)


@pytest.fixture(autouse=True)
def twins() -> Iterator[None]:
    register_densifier("twins")(Twins)
    yield
    del DENSIFIERS._objects["twins"]


def with_twins(**options: object) -> Recipe:
    recipe = train_toys.short()
    return replace(recipe, stages=(replace(recipe.stages[0], densify=Densify("twins", options)),))


def test_a_registered_densifier_adds_splats_and_statistics() -> None:
    trainer = Trainer(train_toys.make_scene(), with_twins(at=4, count=3), train_toys.GENERIC, backend="reference")
    trainer.enter(0)
    before = len(trainer.splats)
    for _ in range(5):
        trainer.step()
    assert len(trainer.splats) == before + 3
    statistics = trainer.state.statistics
    assert statistics is not None
    assert statistics["seen"][-3:].tolist() == [1.0, 1.0, 1.0]  # in the fifth iteration only
    again = TrainState.from_state_dict(trainer.state.state_dict())
    assert again.statistics is not None
    assert torch.equal(again.statistics["seen"], statistics["seen"])


def test_a_recipe_names_a_densifier_and_its_options() -> None:
    recipe = validate(with_twins(at=4, start=100, stop=3000))
    assert from_json(to_json(recipe)) == recipe
    scaled = scale_schedule(recipe, 0.1).stages[0].densify
    assert scaled == Densify("twins", {"at": 4, "start": 10, "stop": 300})
    changed = apply_overrides(recipe, [f"{recipe.stages[0].name}.densify.options.at=9"]).stages[0].densify
    assert isinstance(changed, Densify)
    assert changed.options["at"] == 9


def test_wrong_names_and_options_stop_before_training() -> None:
    wrong = with_twins(at=4)
    with pytest.raises(RecipeError, match="densifier"):
        validate(replace(wrong, stages=(replace(wrong.stages[0], densify=Densify("twinz")),)))
    with pytest.raises(RecipeError, match="options"):
        Trainer(train_toys.make_scene(), with_twins(when=4), train_toys.GENERIC, backend="reference")
