"""Adam in one launch of a CUDA kernel: ``optimizer.adam_step`` for a state on a GPU, without waiting for it."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from torch import Tensor

from gs2d.kernels.cuda import adam, launch
from gs2d.recipe import Stage
from gs2d.train.state import TrainState


def fused_adam_step(
    state: TrainState,
    stage: Stage,
    gradients: Mapping[str, Tensor],
    rates: Mapping[str, float],
    *,
    skip: Collection[str] = (),
    rows: Tensor | None = None,
    cancel: Tensor | None = None,
) -> None:
    """One Adam update, in place, of the rows and attributes that the stage trains.

    Parameters
    ----------
    state, stage, gradients, rates, skip, rows
        As for ``optimizer.adam_step``.
    cancel : Tensor [] int32, optional
        On the device: where it is not 0 nothing is changed (but the step counts, which are the host's).
    """
    updates = []
    for name, parameter in state.splats.items():
        if name not in stage.train or name in skip or parameter.numel() == 0:
            continue
        moments, group = state.moments[name], stage.train[name]
        moments.steps += 1
        updates.append(
            adam.AdamUpdate(
                parameter,
                moments.mean,
                moments.square,
                gradients[name],
                rates[name],
                moments.steps,
                trained=None if group == "all" or rows is not None else state.groups[group],
                rows=None if group == "all" else rows,
                compact=rows is not None and group != "all",
            )
        )
    settings = {"beta1": stage.rates.beta1, "beta2": stage.rates.beta2, "eps": stage.rates.eps}
    adam.adam_step(updates, **settings, launcher=launch.launcher_for(state.splats.device), skip=cancel)
