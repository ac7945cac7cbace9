"""Entry actions of a stage: rank splats by colour error, clone splats in place (the paper's sections 3.2 and 3.3)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from gs2d.config.recipe import CloneInPlace, RankByError
from gs2d.errors import DivergedError
from gs2d.training.rows import append_rows
from gs2d.training.state import TrainState


@torch.no_grad()
def rank_by_error(
    state: TrainState,
    action: RankByError,
    errors_by_view: Iterable[Tensor],
    combine: Callable[[Tensor], Tensor] = lambda total: total,
) -> Tensor:
    """Write the row group of the splats with the largest E_i (paper Eq. 8), and return E [N] float64.

    Parameters
    ----------
    state : TrainState
    action : RankByError
    errors_by_view : iterable of Tensor [N]
        The inner sum of E_i, one per training view.
    combine : callable
        The sum over several processes, of which each gives the errors of some views.

    Raises
    ------
    DivergedError
        If an error is not finite.
    """
    total = torch.zeros(len(state.splats), dtype=torch.float64, device=state.splats.device)
    for errors in errors_by_view:
        total += errors
    total = combine(total)
    if not bool(torch.isfinite(total).all()):
        raise DivergedError("ranking by error met NaN or infinity: a splat or a photograph is not finite")
    group = torch.zeros(len(total), dtype=torch.bool, device=total.device)
    group[worst(total, action.top_percent)] = True
    state.groups[action.writes] = group
    return total


def worst(errors: Tensor, top_percent: float) -> Tensor:
    """Return indices of the ceil(top_percent / 100 * N) largest of errors [N]; of equal ones the lower first."""
    count = math.ceil(round(top_percent * len(errors) / 100, 9))  # 0.1 + 0.2 must not cost a splat
    return torch.sort(errors, descending=True, stable=True).indices[:count]


@torch.no_grad()
def clone_in_place(state: TrainState, action: CloneInPlace) -> int:
    """Append a copy of the rows of a group, and return how many.

    Clones belong to every group of their originals, and to ``action.writes``. With ``opacity="preserve"`` originals and
    clones get 1 - sqrt(1 - o): at their centre two such splats transmit what one of opacity o does.
    """
    rows = state.groups[action.rows].nonzero().squeeze(1)
    if action.opacity == "preserve":
        logits = state.splats.opacity_logits
        logits[rows] = halved_opacity(logits[rows])
    groups = {name: group[rows] for name, group in state.groups.items() if name != action.writes}
    groups[action.writes] = torch.ones(len(rows), dtype=torch.bool, device=rows.device)
    append_rows(state, state.splats.rows(rows), groups)
    return len(rows)


def halved_opacity(logits: Tensor) -> Tensor:
    """Logits of 1 - sqrt(1 - o), o = sigmoid(logits): with q = sqrt(1 - o), log((1 - q) / q)."""
    half_log = 0.5 * torch.nn.functional.logsigmoid(-logits.double())  # log q = log(1 - o) / 2
    return (torch.log(-torch.expm1(half_log)) - half_log).to(logits.dtype)
