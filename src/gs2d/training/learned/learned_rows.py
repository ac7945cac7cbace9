"""Rows of learned numbers, one for each image or camera, with Adam's memory of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gs2d.config.quantities import Learning
from gs2d.core.checks import check_shapes


@dataclass(eq=False)
class LearnedRows:
    """G rows of numbers. A row changes only when an image that it belongs to is trained on.

    Attributes
    ----------
    values, mean, square : Tensor [G, ...]
        The numbers, and running means of their gradient and of its square.
    steps : list of int
        Updates of each row.
    """

    values: Tensor
    mean: Tensor
    square: Tensor
    steps: list[int]

    @classmethod
    def start(cls, values: Tensor) -> LearnedRows:
        """Return rows of these values without a memory."""
        return cls(values, torch.zeros_like(values), torch.zeros_like(values), [0] * len(values))

    def __len__(self) -> int:
        return len(self.steps)

    @torch.no_grad()
    def adam_step(
        self,
        row: int,
        gradient: Tensor,
        rate: float | Tensor,
        settings: Learning,
        *,
        assign: Callable[[Tensor, Tensor], Any] = Tensor.copy_,
        limit: float | None = None,
    ) -> None:
        """Update one row in place.

        Parameters
        ----------
        row : int
        gradient : Tensor
            Like the row.
        rate : float or Tensor
            For all numbers of the row, or for each.
        settings : Learning
            Adam's constants.
        assign : callable
            Writes new values into a tensor. Where it does not, the step is counted all the same.
        limit : float, optional
            Largest absolute value.
        """
        self.steps[row] += 1
        count, beta1, beta2 = self.steps[row], settings.beta1, settings.beta2
        gradient = gradient.to(self.values)
        mean = beta1 * self.mean[row] + (1 - beta1) * gradient
        square = beta2 * self.square[row] + (1 - beta2) * gradient * gradient
        scale = (square / (1 - beta2**count)).sqrt() + settings.eps
        values = self.values[row] - rate / (1 - beta1**count) * mean / scale
        values = values if limit is None else values.clamp(-limit, limit)
        for target, new in ((self.values, values), (self.mean, mean), (self.square, square)):
            assign(target[row], new)

    def move_to(self, device: torch.device | str) -> None:
        """Move all tensors to a device."""
        self.values, self.mean, self.square = (t.to(device) for t in (self.values, self.mean, self.square))

    def state_dict(self) -> dict[str, Any]:
        """Return a deep copy in the host's memory."""
        tensors = {"values": self.values, "mean": self.mean, "square": self.square}
        copies = {name: tensor.detach().to("cpu", copy=True) for name, tensor in tensors.items()}
        return {**copies, "steps": list(self.steps)}

    @classmethod
    def from_state_dict(cls, data: Mapping[str, Any]) -> LearnedRows:
        """Return the rows of :meth:`state_dict` (KeyError, TypeError, AttributeError: it is something else)."""
        values, mean, square = (data[name].clone() for name in ("values", "mean", "square"))
        return cls(values, mean, square, [int(count) for count in data["steps"]])

    def check(self, name: str) -> None:
        """Raise ShapeError unless all tensors have the same shape, and one count for each row."""
        tail = " ".join(["G", *map(str, self.values.shape[1:])])
        tensors = {f"{name} values": self.values, f"{name} means": self.mean, f"{name} squares": self.square}
        arrays = {key: (tensor, tail) for key, tensor in tensors.items()}
        check_shapes({f"{name} steps": (torch.tensor(self.steps), "G")} | arrays)
