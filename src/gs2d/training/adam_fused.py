"""``optimizer.adam_step`` in one call of a kernel, for the cpu and cuda backends; a GPU is not waited for."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from torch import Tensor

from gs2d.config.recipe import Stage
from gs2d.kernels import adam as native
from gs2d.kernels.adam import AdamUpdate
from gs2d.kernels.cuda import adam, launch
from gs2d.training.state import TrainState


def native_adam_step(
    state: TrainState,
    stage: Stage,
    gradients: Mapping[str, Tensor],
    lr: Mapping[str, float],
    *,
    skip: Collection[str] = (),
    rows: Tensor | None = None,
) -> None:
    """``optimizer.adam_step`` by the native CPU library."""
    updates = _updates(state, stage, gradients, lr, skip, rows)
    native.adam_step(updates, beta1=stage.lr.beta1, beta2=stage.lr.beta2, eps=stage.lr.eps)


def fused_adam_step(
    state: TrainState,
    stage: Stage,
    gradients: Mapping[str, Tensor],
    lr: Mapping[str, float],
    *,
    skip: Collection[str] = (),
    rows: Tensor | None = None,
    cancel: Tensor | None = None,
) -> None:
    """``optimizer.adam_step`` in one launch on a GPU.

    Parameters
    ----------
    state, stage, gradients, rates, skip, rows
        As there.
    cancel : Tensor [] int32, optional
        On the device: where it is not 0 nothing is changed (but the step counts, which are the host's).
    """
    updates = _updates(state, stage, gradients, lr, skip, rows)
    settings = {"beta1": stage.lr.beta1, "beta2": stage.lr.beta2, "eps": stage.lr.eps}
    adam.adam_step(updates, **settings, launcher=launch.launcher_for(state.splats.device), skip=cancel)


def _updates(
    state: TrainState,
    stage: Stage,
    gradients: Mapping[str, Tensor],
    lr: Mapping[str, float],
    skip: Collection[str],
    rows: Tensor | None,
) -> list[AdamUpdate]:
    """What each attribute that the stage trains does; their steps are counted."""
    updates = []
    for name, parameter in state.splats.items():
        if name not in stage.train or name in skip or parameter.numel() == 0:
            continue
        moments, group = state.moments[name], stage.train[name]
        moments.steps += 1
        updates.append(
            AdamUpdate(
                parameter,
                moments.mean,
                moments.square,
                gradients[name],
                lr[name],
                moments.steps,
                trained=None if group == "all" or rows is not None else state.groups[group],
                rows=None if group == "all" else rows,
                compact=rows is not None and group != "all",
            )
        )
    return updates
