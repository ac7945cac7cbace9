"""States of training as checkpoints keep them: bytes, there and back."""

from __future__ import annotations

import io

import torch

from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer


def reload(data: bytes) -> TrainState:
    return TrainState.from_state_dict(torch.load(io.BytesIO(data), weights_only=True))


def saved(trainer: Trainer) -> bytes:
    file = io.BytesIO()
    torch.save(trainer.state.state_dict(), file)
    return file.getvalue()
