"""Losses and gradients of one training view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True, eq=False)
class StepResult:
    """Losses and gradients of one training view."""

    # Weighted losses by kind. On a GPU they are tensors [], because reading them would wait for the device.
    losses: Mapping[str, float | Tensor]
    # Gradients by attribute, of those that the stage trains; with ``rows``, of these rows alone, in their order.
    gradients: Mapping[str, Tensor]
    signal: Tensor | None  # screen gradients [N, 2] or [N, 4], if a densifier gathers them
    radii: Tensor | None  # [N] px; None if the view was not projected
    rows: Tensor | None = None  # [M] int64
    # Gradients of the learned quantities of the image and its camera (``gs2d.training.learned``), by name.
    learned: Mapping[str, Tensor] = field(default_factory=dict)
