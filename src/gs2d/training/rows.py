"""The only functions that change N: parameters, moments, statistics and row groups change together.

Each makes one pass: the kept rows of each tensor are gathered into new storage with room for the added rows.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.core.splats import Splats
from gs2d.errors import ShapeError
from gs2d.training.state import TrainState


def keep_rows(state: TrainState, mask: Tensor) -> None:
    """Drop every row where ``mask`` (bool [N]) is False; the others keep their order."""
    append_rows(state, _no_rows(state.splats), keep=mask)


@torch.no_grad()
def append_rows(
    state: TrainState,
    splats: Splats,
    groups: Mapping[str, Tensor] | None = None,
    *,
    keep: Tensor | None = None,
) -> None:
    """Append M splats with zero moments and statistics.

    Parameters
    ----------
    state : TrainState
    splats : Splats
        M rows.
    groups : mapping of name to bool Tensor [M], optional
        Membership of the new rows; False in groups of the state that are not named. A new name becomes a group without
        old rows.
    keep : Tensor [N] bool, optional
        Drop the old rows where it is False, in the same pass.
    """
    groups = {} if groups is None else groups
    check_shapes({"means": (splats.means, "M 3")} | {f"group {k}": (mask, "M") for k, mask in groups.items()})
    rows = _Rows(state, len(splats), keep)
    added = dict(splats.items())
    state.splats = Splats(**{name: rows.of(t.detach(), added[name].detach()) for name, t in state.splats.items()})
    for moments in state.moments.values():
        moments.mean = rows.of(moments.mean)
        moments.square = rows.of(moments.square)
    if state.statistics is not None:
        state.statistics = {name: rows.of(tensor) for name, tensor in state.statistics.items()}
    new_names = [name for name in groups if name not in state.groups]
    nowhere = torch.zeros(rows.before if new_names else 0, dtype=torch.bool, device=state.splats.device)
    old_groups = state.groups | dict.fromkeys(new_names, nowhere)
    state.groups = {name: rows.of(group, groups.get(name)) for name, group in old_groups.items()}


class _Rows:
    """Old rows that are kept, and the number of new rows."""

    def __init__(self, state: TrainState, added: int, keep: Tensor | None) -> None:
        self.before, self.added = len(state.splats), added
        self.kept: Tensor | None = None  # [K] int64; None = all
        if keep is not None:
            check_shapes({"means": (state.splats.means, "N 3"), "mask": (keep, "N")})
            if keep.dtype != torch.bool:
                raise ShapeError(f"mask must be bool [N], got {keep.dtype}")
            kept = keep.nonzero().squeeze(1)
            self.kept = None if len(kept) == self.before else kept

    def of(self, old: Tensor, new: Tensor | None = None) -> Tensor:
        """Return the kept rows of ``old``, followed by those of ``new`` or zeros."""
        if self.kept is None and self.added == 0:
            return old
        stay = self.before if self.kept is None else len(self.kept)
        result = old.new_empty(stay + self.added, *old.shape[1:])
        if self.kept is None:
            result[:stay] = old
        else:
            torch.index_select(old, 0, self.kept, out=result[:stay])
        result[stay:] = 0 if new is None else new
        return result


def _no_rows(splats: Splats) -> Splats:
    return Splats(**{name: tensor[:0] for name, tensor in splats.items()})
