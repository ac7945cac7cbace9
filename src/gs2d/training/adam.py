"""Adam over the six attributes, for all rows or for a row group; rows that are not trained are never written.

The arithmetic is torch's fused Adam; moments live in the TrainState, so that rows can come and go. A backend does it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from torch import Tensor

from gs2d.config.recipe import LearningRates, Stage
from gs2d.core.splats import ATTRIBUTES
from gs2d.kernels.native_adam import AdamUpdate
from gs2d.render.backends import PLAIN, Backend
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
    settled = lr.settled_at(iteration)
    fixed = {name: float(getattr(lr, name)) * settled for name in ATTRIBUTES}
    return fixed | {"means": lr.means_at(iteration) * extent}


def adam_step(
    state: TrainState,
    stage: Stage,
    gradients: Mapping[str, Tensor],
    lr: Mapping[str, float],
    *,
    backend: Backend = PLAIN,
    skip: Collection[str] = (),
    rows: Tensor | None = None,
    views: int = 1,
) -> None:
    """One Adam update, in place, of the rows and attributes that the stage trains.

    Parameters
    ----------
    state : TrainState
    stage : Stage
    gradients : mapping of attribute to Tensor
        Like the attributes; rows outside a row group are not read. With ``rows``, only of those, in their order.
    lr : mapping of attribute to float
    backend : Backend
        Does it; by default plain torch.
    skip : attributes that are left alone this time
    rows : Tensor [M] int64, optional
        The rows of the group that the stage trains, where the gradients are of those alone.
    views : int
        Of which the gradients are the mean, in one step: beta and eps are those of ``LearningRates.for_views``. Steps
        are counted in views, so that the bias correction, 1 - (beta^views)^(steps / views), knows of no batches.
    """
    rates, updates = stage.lr.for_views(views), []
    for name, parameter in state.splats.items():
        if name not in stage.train or name in skip or parameter.numel() == 0:
            continue
        moments, group = state.moments[name], stage.train[name]
        moments.steps += views
        updates.append(
            AdamUpdate(
                parameter,
                moments.mean,
                moments.square,
                gradients[name],
                lr[name],
                moments.steps if views == 1 else moments.steps / views,
                trained=None if group == "all" or rows is not None else state.groups[group],
                rows=None if group == "all" else rows,
                compact=rows is not None and group != "all",
            )
        )
    backend.adam_step(updates, beta1=rates.beta1, beta2=rates.beta2, eps=rates.eps)
