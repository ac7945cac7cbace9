"""Resuming is exact: after any event, after a kill, and from a shared stage; foreign states are rejected."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import Recipe
from gs2d.contrib.lab.paper_recipes import continue_training
from gs2d.data.scene import Scene
from gs2d.errors import RunError
from gs2d.training import events
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer, TrainerOptions
from saved_states import reload, saved
from train_toys import backends, random_splats, same, short, train


@pytest.mark.parametrize("absgs", [False, True])
def test_resuming_from_any_event_gives_the_same_bytes(scene: Scene, absgs: bool) -> None:
    kept: list[tuple[events.TrainingEvent, bytes]] = []
    backend = backends()[-1]
    trainer = Trainer(
        scene,
        short(absgs),
        GENERIC,
        backend=backend,
        on_event=lambda event: kept.append((event, saved(trainer))),
        options=TrainerOptions(progress_every=1),
    )
    end = trainer.run()
    robust = {events.FloatersRemoved}  # only in robust recipes, see test_robust
    assert {type(event) for event, _ in kept} == set(events.TrainingEvent.__subclasses__()) - robust
    for event, data in kept[:: 1 if backend == "cpu" else 5]:
        resumed = Trainer(scene, short(absgs), GENERIC, backend=backend, state=reload(data))
        assert same(resumed.run(), end), event


def test_a_finished_stage_can_be_shared_with_a_recipe_of_the_same_first_stage(scene: Scene) -> None:
    first = short().stages[0]
    longer = Recipe("longer", (first, replace(continue_training(), iterations=4)))
    at_finish: list[bytes] = []

    def on_event(event: events.TrainingEvent) -> None:
        if isinstance(event, events.StageFinished) and event.index == 0:
            at_finish.append(saved(trainer))

    trainer = Trainer(scene, short(), GENERIC, backend="reference", on_event=on_event)
    trainer.run()
    shared = Trainer(scene, longer, GENERIC, backend="reference", state=reload(at_finish[0]))
    assert same(shared.run(), Trainer(scene, longer, GENERIC, backend="reference").run())
    assert shared.state.moments["means"].steps > 4  # kept


def test_a_finished_run_trains_nothing(scene: Scene) -> None:
    trainer, _ = train(scene, short())
    again = Trainer(scene, short(), GENERIC, backend="reference", state=reload(saved(trainer)))
    assert again.done
    assert same(again.run(), trainer.splats)


def test_states_of_another_recipe_or_scene_are_refused(scene: Scene) -> None:
    state = TrainState(random_splats(5, degree=2), torch.Generator())
    with pytest.raises(RunError, match="SH degree 2"):
        Trainer(scene, short(), GENERIC, backend="reference", state=state)
    for stage, step in ((0, 11), (3, 1), (4, 0)):
        state = TrainState(random_splats(5), torch.Generator(), stage=stage, step=step)
        with pytest.raises(RunError, match=f"stage {stage}, iteration {step}"):
            Trainer(scene, short(), GENERIC, backend="reference", state=state)
    state = TrainState(random_splats(5), torch.Generator(), queue=[6])
    with pytest.raises(RunError, match="view 6"):
        Trainer(scene, short(), GENERIC, backend="reference", state=state)
