"""Rows of learned numbers, one for each image or camera, with their Adam moments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gs2d.core.checks import check_shapes


@dataclass(eq=False)
class LearnedRows:
    """G rows of numbers. A row is updated when one of its images is trained on.

    Attributes
    ----------
    values, mean, square : Tensor [G, ...]
        The numbers, and running means of the gradient and of its square.
    steps : list of int
        Number of updates of each row.
    """

    values: Tensor
    mean: Tensor
    square: Tensor
    steps: list[int]

    @classmethod
    def start(cls, values: Tensor) -> LearnedRows:
        """Return rows of these values with zero moments."""
        return cls(values, torch.zeros_like(values), torch.zeros_like(values), [0] * len(values))

    def __len__(self) -> int:
        return len(self.steps)

    @torch.no_grad()
    def adam_step(
        self,
        row: int,
        gradient: Tensor,
        rate: float | Tensor,
        *,
        constants: tuple[float, float, float],
        assign: Callable[[Tensor, Tensor], Any] = Tensor.copy_,
    ) -> None:
        """Update one row in place.

        Parameters
        ----------
        row : int
        gradient : Tensor
            Gradient of the row.
        rate : float or Tensor
            Learning rate of all numbers of the row, or of each.
        constants : 3 floats
            Adam's beta1, beta2 and eps.
        assign : callable
            Writes new values into a tensor. The step is counted even if it writes nothing.
        """
        self.steps[row] += 1
        count, (beta1, beta2, eps) = self.steps[row], constants
        gradient = gradient.to(self.values)
        mean = beta1 * self.mean[row] + (1 - beta1) * gradient
        square = beta2 * self.square[row] + (1 - beta2) * gradient * gradient
        scale = (square / (1 - beta2**count)).sqrt() + eps
        values = self.values[row] - rate / (1 - beta1**count) * mean / scale
        for target, new in ((self.values, values), (self.mean, mean), (self.square, square)):
            assign(target[row], new)

    def move_to(self, device: torch.device | str) -> None:
        """Move all tensors to a device."""
        self.values, self.mean, self.square = (t.to(device) for t in (self.values, self.mean, self.square))

    def state_dict(self) -> dict[str, Any]:
        """Return a deep copy in host memory."""
        tensors = {"values": self.values, "mean": self.mean, "square": self.square}
        copies = {name: tensor.detach().to("cpu", copy=True) for name, tensor in tensors.items()}
        return {**copies, "steps": list(self.steps)}

    @classmethod
    def from_state_dict(cls, data: Mapping[str, Any]) -> LearnedRows:
        """Return the rows of a :meth:`state_dict`; raise KeyError, TypeError or AttributeError for other data."""
        values, mean, square = (data[name].clone() for name in ("values", "mean", "square"))
        return cls(values, mean, square, [int(count) for count in data["steps"]])

    def check(self, name: str) -> None:
        """Raise ShapeError unless all tensors have the same shape, and each row has a count."""
        tail = " ".join(["G", *map(str, self.values.shape[1:])])
        tensors = {f"{name} values": self.values, f"{name} means": self.mean, f"{name} squares": self.square}
        arrays = {key: (tensor, tail) for key, tensor in tensors.items()}
        check_shapes({f"{name} steps": (torch.tensor(self.steps), "G")} | arrays)
