"""The only functions that change N: parameters, moments, statistics and row groups change together.

Each makes one pass: the retained rows of each tensor are gathered into new storage with room for the added rows.
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
    nothing = Splats(**{name: tensor[:0] for name, tensor in state.splats.items()})
    append_rows(state, nothing, keep=mask)


@torch.no_grad()
def append_rows(
    state: TrainState,
    splats: Splats,
    groups: Mapping[str, Tensor] | None = None,
    *,
    keep: Tensor | None = None,
) -> None:
    """Append M splats with zero moments and statistics.

    ``splats``: M rows. ``groups`` [M] bool: membership of the new rows; False in groups of the state that are not
    named. A new name becomes a group without old rows. ``keep`` [N] bool: drop the old rows where it is False, in the
    same pass.
    """
    groups = {} if groups is None else groups
    check_shapes({"means": (splats.means, "M 3")} | {f"group {k}": (mask, "M") for k, mask in groups.items()})
    before, added, retained = len(state.splats), len(splats), _retained_rows(state, keep)
    stay = before if retained is None else len(retained)

    def rows_of(old: Tensor, new: Tensor | None = None) -> Tensor:
        """Return the retained rows of ``old``, followed by those of ``new`` or zeros."""
        if retained is None and added == 0:
            return old
        result = old.new_empty(stay + added, *old.shape[1:])
        if retained is None:
            result[:stay] = old
        else:
            torch.index_select(old, 0, retained, out=result[:stay])
        result[stay:] = 0 if new is None else new
        return result

    own = dict(splats.items())
    state.splats = Splats(**{name: rows_of(t.detach(), own[name].detach()) for name, t in state.splats.items()})
    for moments in state.moments.values():
        moments.mean = rows_of(moments.mean)
        moments.square = rows_of(moments.square)
    if state.statistics is not None:
        state.statistics = {name: rows_of(tensor) for name, tensor in state.statistics.items()}
    new_names = [name for name in groups if name not in state.groups]
    nowhere = torch.zeros(before if new_names else 0, dtype=torch.bool, device=state.splats.device)
    old_groups = state.groups | dict.fromkeys(new_names, nowhere)
    state.groups = {name: rows_of(group, groups.get(name)) for name, group in old_groups.items()}


def _retained_rows(state: TrainState, keep: Tensor | None) -> Tensor | None:
    """Return the retained rows [K] int64; None: all."""
    if keep is None:
        return None
    check_shapes({"means": (state.splats.means, "N 3"), "mask": (keep, "N")})
    if keep.dtype != torch.bool:
        raise ShapeError(f"mask must be bool [N], got {keep.dtype}")
    retained = keep.nonzero().squeeze(1)
    return None if len(retained) == len(keep) else retained
