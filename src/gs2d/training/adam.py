"""Adam over the six attributes, for all rows or for a row group; rows that are not trained are never written.

The arithmetic is torch's fused Adam; moments live in the TrainState, so that rows can come and go.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor
from torch.optim.adam import adam

from gs2d.config.recipe import LearningRates, Stage
from gs2d.core.splats import ATTRIBUTES
from gs2d.training.state import Moments, TrainState


def begin_stage(state: TrainState, stage: Stage) -> None:
    """Moments for the attributes that the stage trains: all zero, or ("kept") only those that are missing."""
    parameters = dict(state.splats.items())
    kept = state.moments if stage.moments == "kept" else {}
    trained = {
        name: kept.get(name) or Moments.zeros_like(parameters[name]) for name in ATTRIBUTES if name in stage.train
    }
    state.moments = kept | trained


def lr_at(lr: LearningRates, iteration: int, extent: float) -> dict[str, float]:
    """Learning rates at an iteration (1-based), by attribute; that of the means is in world units: times the extent."""
    fixed = {name: float(getattr(lr, name)) for name in ATTRIBUTES}
    return fixed | {"means": lr.means_at(iteration) * extent}


@torch.no_grad()
def adam_step(
    state: TrainState,
    stage: Stage,
    gradients: Mapping[str, Tensor],
    lr: Mapping[str, float],
    *,
    skip: Collection[str] = (),
    rows: Tensor | None = None,
) -> None:
    """One Adam update, in place, of the rows and attributes that the stage trains.

    Parameters
    ----------
    state : TrainState
    stage : Stage
    gradients : mapping of attribute to Tensor
        Like the attributes; rows outside a row group are not read. With ``rows``, only of those, in their order.
    rates : mapping of attribute to float
    skip : attributes that are left alone this time
    rows : Tensor [M] int64, optional
        The rows of the group that the stage trains, where the gradients are of those alone.
    """
    for name, parameter in state.splats.items():
        if name not in stage.train or name in skip or parameter.numel() == 0:
            continue
        moments, group = state.moments[name], stage.train[name]
        moments.steps += 1
        if group == "all":
            _update(parameter, gradients[name], moments.mean, moments.square, moments.steps, lr[name], stage.lr)
            continue
        trained = state.groups[group].nonzero().squeeze(1) if rows is None else rows  # [M]
        if len(trained) == 0:
            continue
        gradient = gradients[name][trained] if rows is None else gradients[name]
        whole = (parameter, moments.mean, moments.square)
        parts = [tensor[trained] for tensor in whole]
        _update(parts[0], gradient, parts[1], parts[2], moments.steps, lr[name], stage.lr)
        for tensor, part in zip(whole, parts, strict=True):
            tensor[trained] = part


def _update(
    parameter: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, steps: int, rate: float, settings: LearningRates
) -> None:
    """Adam with bias correction, in place (``steps`` counts this update)."""
    step = torch.tensor(float(steps - 1), device=parameter.device)  # adam() adds one
    adam(
        [parameter],
        [gradient.contiguous()],
        [mean],
        [square],
        [],
        [step],
        fused=True,
        amsgrad=False,
        beta1=settings.beta1,
        beta2=settings.beta2,
        lr=rate,
        weight_decay=0.0,
        eps=settings.eps,
        maximize=False,
    )
