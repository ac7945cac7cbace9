"""The only two functions that change N: parameters, moments, statistics and row groups move together or not at all."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from gs2d.check import check_shapes
from gs2d.errors import ShapeError
from gs2d.splats import Splats
from gs2d.train.state import TrainState


def keep_rows(state: TrainState, mask: Tensor) -> None:
    """Drop every row where ``mask`` (bool [N]) is False; the others keep their order."""
    check_shapes({"means": (state.splats.means, "N 3"), "mask": (mask, "N")})
    if mask.dtype != torch.bool:
        raise ShapeError(f"mask must be bool [N], got {mask.dtype}")
    state.splats = state.splats.rows(mask)
    for moments in state.moments.values():
        moments.mean, moments.square = moments.mean[mask], moments.square[mask]
    state.groups = {name: group[mask] for name, group in state.groups.items()}
    if state.statistics is not None:
        for name, tensor in vars(state.statistics).items():
            setattr(state.statistics, name, tensor[mask])


def append_rows(state: TrainState, splats: Splats, groups: Mapping[str, Tensor] | None = None) -> None:
    """Append M splats: zero moments and statistics.

    Parameters
    ----------
    state : TrainState
    splats : Splats
        M rows.
    groups : mapping of name to bool Tensor [M], optional
        Membership of the new rows. Groups of the state that are not named get False; a new name becomes a group in
        which no old row is.
    """
    groups = {} if groups is None else groups
    check_shapes({"means": (splats.means, "M 3")} | {f"group {k}": (mask, "M") for k, mask in groups.items()})
    old, new = len(state.splats), len(splats)
    added = dict(splats.items())
    state.splats = Splats(**{name: torch.cat([t, added[name].detach()]) for name, t in state.splats.items()})
    for moments in state.moments.values():
        moments.mean, moments.square = _pad(moments.mean, new), _pad(moments.square, new)
    if state.statistics is not None:
        for name, tensor in vars(state.statistics).items():
            setattr(state.statistics, name, _pad(tensor, new))
    device = state.splats.device
    for name in [*state.groups, *(name for name in groups if name not in state.groups)]:
        before = state.groups.get(name, torch.zeros(old, dtype=torch.bool, device=device))
        after = groups.get(name, torch.zeros(new, dtype=torch.bool, device=device))
        state.groups[name] = torch.cat([before, after])


def _pad(tensor: Tensor, rows: int) -> Tensor:
    return torch.cat([tensor, tensor.new_zeros(rows, *tensor.shape[1:])])
