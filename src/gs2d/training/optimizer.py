"""Adam for the six attributes of splats, for all rows or for a row group; other rows are never written.

The arithmetic is that of torch's fused Adam, computed by the backend. The TrainState holds the moments, so that rows
can be added and removed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from torch import Tensor

from gs2d.config.recipe import LearningRates, Stage
from gs2d.core.splats import ATTRIBUTES
from gs2d.kernels.adam_update import AdamUpdate
from gs2d.render.backends import Backend
from gs2d.render.reference_backend import PLAIN
from gs2d.training.state import Moments, TrainState


def begin_stage(state: TrainState, stage: Stage) -> None:
    """Set the moments of the attributes that the stage trains: zeros, or with "kept" only the missing ones."""
    parameters = dict(state.splats.items())
    previous = state.moments if stage.moments == "kept" else {}
    trained = {
        name: previous.get(name) or Moments.zeros_like(parameters[name]) for name in ATTRIBUTES if name in stage.train
    }
    state.moments = previous | trained


def lr_at(lr: LearningRates, iteration: int, extent: float) -> dict[str, float]:
    """Return the learning rates at an iteration (1-based) by attribute; that of the means is in world units."""
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
    """Update the rows and attributes that the stage trains, in place.

    ``gradients``: gradients of the attributes; rows outside a row group are not read. With ``rows``, of these rows
    alone. ``backend``: by default plain torch. ``skip``: attributes that are not updated. ``rows`` [M] int64: rows of
    the group that the stage trains, if the gradients are restricted to them. ``views``: number of views that the
    gradients average. Betas and eps are those of ``LearningRates.for_views``. Steps are counted in views, so that the
    bias correction does not depend on the number of views.
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
