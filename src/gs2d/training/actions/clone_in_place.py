"""Clone splats in place (the paper's section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gs2d.config.actions import register_action
from gs2d.config.validate import one_of
from gs2d.training import events
from gs2d.training.actions.entry_action import EntryAction, StageEntry
from gs2d.training.rows import append_rows
from gs2d.training.state import TrainState


@register_action("clone_in_place")
class CloneInPlace(EntryAction):
    """Append a copy of the rows of a group.

    Clones belong to every group of their originals, and to the group ``writes`` of their own. With ``opacity``
    "preserve" instead of "copy", both get 1 - sqrt(1 - o), so that the transmittance at their centre stays 1 - o.
    """

    def __init__(self, rows: str, writes: str, opacity: str = "copy") -> None:
        one_of("clone_in_place: opacity", opacity, ("copy", "preserve"))
        self.rows, self.writes, self.opacity = rows, writes, opacity

    @torch.no_grad()
    def run(self, state: TrainState, entry: StageEntry) -> Sequence[events.TrainingEvent]:
        """Append the clones."""
        rows = state.groups[self.rows].nonzero().squeeze(1)
        if self.opacity == "preserve":
            logits = state.splats.opacity_logits
            logits[rows] = halved_opacity(logits[rows])
        groups = {name: group[rows] for name, group in state.groups.items() if name != self.writes}
        groups[self.writes] = torch.ones(len(rows), dtype=torch.bool, device=rows.device)
        append_rows(state, state.splats.rows(rows), groups)
        return (events.Cloned(entry.stage, self.writes, len(rows), self.opacity, len(state.splats)),)


def halved_opacity(logits: Tensor) -> Tensor:
    """Return the logits of 1 - sqrt(1 - o), o = sigmoid(logits): with q = sqrt(1 - o), log((1 - q) / q)."""
    half_log = 0.5 * torch.nn.functional.logsigmoid(-logits.double())  # log q = log(1 - o) / 2
    return (torch.log(-torch.expm1(half_log)) - half_log).to(logits.dtype)
