"""Convert training states to checkpoint bytes and back."""

from __future__ import annotations

import io

import torch

from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import Recipe
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer, TrainerOptions
from train_toys import same


def reload(data: bytes) -> TrainState:
    return TrainState.from_state_dict(torch.load(io.BytesIO(data), weights_only=True))


def saved(trainer: Trainer) -> bytes:
    file = io.BytesIO()
    torch.save(trainer.state.state_dict(), file)
    return file.getvalue()


def resumed_everywhere(scene: Scene, recipe: Recipe, backend: str, every: int = 5) -> Splats:
    """Train, resume from the state at each ``every``-th event, and return all final states."""
    saves: list[bytes] = []
    trainer = Trainer(
        scene,
        recipe,
        GENERIC,
        backend=backend,
        on_event=lambda _: saves.append(saved(trainer)),
        options=TrainerOptions(progress_every=1),
    )
    end = trainer.run()
    for data in saves[::every]:
        resumed = Trainer(scene, recipe, GENERIC, backend=backend, state=reload(data))
        assert same(resumed.run(), end)
        for name, rows in resumed.state.learned.items():
            assert torch.equal(rows.values, trainer.state.learned[name].values), name
            assert rows.steps == trainer.state.learned[name].steps
    return end
