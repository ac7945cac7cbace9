"""Frozen splats rendered together with those in training, and fixed exposures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.config.protocols import GENERIC
from gs2d.config.quantities import EXPOSURE
from gs2d.config.recipe import Recipe
from gs2d.core.splats import Splats
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from train_toys import backends, grouped, make_scene, random_splats, short

SCENE = make_scene()


def trainer_of(
    recipe: Recipe, own: Splats, frozen: Splats | None, backend: str, state: TrainState | None = None, **more: object
) -> Trainer:
    init = own if state is None else None
    given = {"backend": backend, "init": init, "state": state, "frozen": frozen} | more
    return Trainer(SCENE, recipe, GENERIC, **grouped(given))


def same(one: Splats, other: Splats) -> bool:
    return all(torch.equal(a, b) for (_, a), (_, b) in zip(one.items(), other.items(), strict=True))


@pytest.mark.parametrize("backend", backends())
def test_trained_splats_get_the_same_gradients_beside_frozen_ones(backend: str) -> None:
    whole = random_splats(40)
    own, frozen = whole.rows(torch.arange(25)), whole.rows(torch.arange(25, 40))
    apart, together = (
        trainer_of(short(), splats, others, backend) for splats, others in ((own, frozen), (whole, None))
    )
    for trainer in (apart, together):
        trainer.enter(0)
        trainer.state.step = 7
    stage, found = short().stages[0], []
    for trainer in (apart, together):
        probe = torch.zeros(len(trainer.splats), 2, requires_grad=True)
        found.append(trainer._whole.evaluate(trainer.state, stage, 8, 1, probe))
    part, all_of_it = found
    assert part.losses == all_of_it.losses
    assert part.gradients.keys() == all_of_it.gradients.keys()
    for name, gradient in part.gradients.items():
        assert torch.equal(gradient, all_of_it.gradients[name][:25]), name
        assert bool(gradient.any()), name
    assert part.signal is not None
    assert all_of_it.signal is not None
    assert torch.equal(part.signal, all_of_it.signal[:25])
    assert part.radii is not None
    assert all_of_it.radii is not None
    assert torch.equal(part.radii, all_of_it.radii[:25])


@pytest.mark.parametrize("backend", backends())
def test_frozen_splats_never_change(backend: str) -> None:
    whole = random_splats(60)
    own, frozen = whole.rows(torch.arange(45)), whole.rows(torch.arange(45, 60))
    before = frozen.clone()
    trainer = trainer_of(short(), own, frozen, backend)
    counts = []
    trainer._on_event = lambda event: counts.append(getattr(event, "splats", None))
    splats = trainer.run()
    assert same(frozen, before)
    assert len(trainer.drawn) == len(splats) + 15
    assert same(trainer.drawn.rows(torch.arange(len(splats), len(splats) + 15)), before)
    assert len(splats) != 45  # densified and cloned
    assert not same(splats, trainer_of(short(), own, None, backend).run())  # the surroundings matter


def test_a_run_with_frozen_splats_resumes_to_the_same_bytes() -> None:
    whole = random_splats(60)
    own, frozen = whole.rows(torch.arange(45)), whole.rows(torch.arange(45, 60))
    saved: list[dict[str, object]] = []
    straight = trainer_of(short(), own, frozen, backends()[-1], progress_every=1)
    straight._on_event = lambda event: saved.append(straight.state.state_dict()) if straight.state.step == 7 else None
    end = straight.run()
    state = TrainState.from_state_dict(saved[-1])
    assert (state.stage, state.step) == (0, 7)
    assert same(trainer_of(short(), own, frozen, backends()[-1], state).run(), end)


def test_a_part_without_a_dense_start_begins_with_init() -> None:
    own, frozen = random_splats(45), random_splats(30, seed=1)
    asked: list[int] = []

    def within(places: torch.Tensor) -> torch.Tensor:
        asked.append(len(places))
        return places[:, 0] > 0

    trainer = trainer_of(short(), own, frozen, backends()[-1], within=within)
    assert same(trainer.splats, own)
    assert asked == []  # only a dense start has points


# -- exposures ---------------------------------------------------------------------------------------------------------
GIVEN = short().with_learned(replace(EXPOSURE, start=0, decay_steps=10).with_options(initial="given"))


def transforms() -> torch.Tensor:
    """Return six transforms whose mean is not the identity."""
    gains = torch.linspace(0.5, 0.9, 6)
    return torch.cat([torch.eye(3) * gains[:, None, None], torch.zeros(6, 3, 1)], dim=2)


def test_given_exposures_are_constant() -> None:
    trainer = trainer_of(GIVEN, random_splats(40), None, backends()[-1], exposures=transforms())
    rows = trainer.state.learned["exposure"]
    before = np.stack([view.appearance["exposure"] for view in trainer.scene_now().train])
    assert np.allclose(before, transforms(), atol=1e-7)
    trainer.run()
    after = np.stack([view.appearance["exposure"] for view in trainer.scene_now().train])
    assert np.array_equal(after, before)
    again = TrainState.from_state_dict(trainer.state.state_dict()).learned["exposure"]
    assert torch.equal(again.values, rows.values)
