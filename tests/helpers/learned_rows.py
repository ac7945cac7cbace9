"""Learned quantities for tests: a training state with its rows, and single updates."""

from __future__ import annotations

import torch

from gs2d.config.recipe import Recipe
from gs2d.data.scene import Scene
from gs2d.render.backends import Backend
from gs2d.render.reference_backend import PLAIN
from gs2d.training.learned.learned_table import LearnedTable
from gs2d.training.state import TrainState


def begun(state: TrainState, recipe: Recipe, scene: Scene) -> TrainState:
    """Return the state at the start of training, including learned rows."""
    state.learned = LearnedTable(recipe, scene).start(state.splats.means, {})
    return state


class Learner:
    """The table of a recipe's learned quantities and their rows; rows are float32 when stored beside the splats."""

    def __init__(self, recipe: Recipe, scene: Scene) -> None:
        self.table = LearnedTable(recipe, scene)
        self.rows = self.table.start(torch.zeros(1), {})

    def step(
        self, name: str, index: int, gradient: list[float] | torch.Tensor, rate: float, backend: Backend = PLAIN
    ) -> None:
        """Update the row of a view."""
        shaped = torch.as_tensor(gradient, dtype=torch.float64).reshape(self.table.shapes[name])
        self.table.update(self.rows, index, {name: shaped}, {name: rate}, backend)

    def numbers(self, name: str, index: int) -> torch.Tensor:
        """Return the values of a view."""
        return self.table.quantities[name].numbers(self.rows[name].values, index)
