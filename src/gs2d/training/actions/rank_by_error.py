"""Rank splats by colour error (the paper's section 3.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gs2d.config.actions import register_action
from gs2d.config.validate import number, require
from gs2d.errors import DivergedError
from gs2d.training import events
from gs2d.training.actions.entry_action import EntryAction, StageEntry
from gs2d.training.state import TrainState


@register_action("rank_by_error")
class RankByError(EntryAction):
    """Write the row group of the ``top_percent`` of the splats with the largest E_i.

    ``occlusion``: whether a pixel counts only for the splats that are blended there.
    """

    def __init__(self, writes: str, top_percent: float = 1.0, occlusion: bool = False) -> None:
        percent = number("rank_by_error: top_percent", top_percent, low=0.0)
        require(0 < percent <= 100, f"rank_by_error: top_percent must be in (0, 100], got {percent}")
        self.writes, self.top_percent, self.occlusion = writes, percent, occlusion

    @torch.no_grad()
    def run(self, state: TrainState, entry: StageEntry) -> Sequence[events.TrainingEvent]:
        """Rank the splats by E_i over all training views (paper Eq. 8); raise DivergedError if one is not finite."""
        total = torch.zeros(len(state.splats), dtype=torch.float64, device=state.splats.device)
        for errors in entry.errors(self.occlusion):
            total += errors
        total = entry.processes.sum(total)
        if not bool(torch.isfinite(total).all()):
            raise DivergedError("ranking by error met NaN or infinity: a splat or a photograph is not finite")
        group = torch.zeros(len(total), dtype=torch.bool, device=total.device)
        group[worst(total, self.top_percent)] = True
        state.groups[self.writes] = group
        fraction = float(total[group].sum() / total.sum().clamp(min=1e-300))
        least = float(total[group].min())
        return (events.Ranked(entry.stage, self.writes, int(group.sum()), least, fraction),)


def worst(errors: Tensor, top_percent: float) -> Tensor:
    """Return the indices of the ceil(top_percent / 100 * N) largest errors [N]; the lower index wins a tie."""
    count = math.ceil(round(top_percent * len(errors) / 100, 9))  # 0.1 + 0.2 must not cost a splat
    return torch.sort(errors, descending=True, stable=True).indices[:count]
