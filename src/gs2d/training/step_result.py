"""Losses and gradients of one training view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True, eq=False)
class StepResult:
    """Losses and gradients of one training view.

    Attributes
    ----------
    losses : mapping of kind to float or Tensor []
        Weighted losses. On a GPU they are tensors, because reading them would wait for the device.
    gradients : mapping of attribute to Tensor
        Gradients of the trained attributes; with ``rows``, of these rows alone, in their order.
    signal : Tensor [N, 2] or [N, 4], or None
        Screen gradients, if a densifier gathers them.
    radii : Tensor [N] px or None
        None if the view was not projected.
    rows : Tensor [M] int64 or None
    learned : mapping of name to Tensor
        Gradients of the learned quantities of the image and its camera (``gs2d.training.learned``).
    """

    losses: Mapping[str, float | Tensor]
    gradients: Mapping[str, Tensor]
    signal: Tensor | None
    radii: Tensor | None
    rows: Tensor | None = None
    learned: Mapping[str, Tensor] = field(default_factory=dict)
