"""What the kernels do between two renderings, in plain torch: it judges them, and serves where there are none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.optim.adam import adam

from gs2d.kernels.native_adam import AdamUpdate

__all__ = ["accumulate", "adam_step", "finite", "first_not_finite"]


@torch.no_grad()
def adam_step(updates: Sequence[AdamUpdate], *, beta1: float, beta2: float, eps: float) -> None:
    """One Adam step of some attributes, in place, by torch's fused Adam; rows that are not trained are not written."""
    for update in updates:
        whole = (update.parameter, update.mean, update.square)
        rows = update.rows if update.trained is None else update.trained.nonzero().squeeze(1)  # [M]
        if rows is None:
            _adam(update, *whole, update.gradient, beta1, beta2, eps)
            continue
        if len(rows) == 0:
            continue
        parts = (update.parameter[rows], update.mean[rows], update.square[rows])
        _adam(update, *parts, update.gradient if update.compact else update.gradient[rows], beta1, beta2, eps)
        for tensor, part in zip(whole, parts, strict=True):
            tensor[rows] = part


def _adam(
    update: AdamUpdate,
    parameter: Tensor,
    mean: Tensor,
    square: Tensor,
    gradient: Tensor,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """Adam with bias correction, in place."""
    step = torch.tensor(float(update.step - 1), device=parameter.device)  # adam() adds one
    adam(
        [parameter],
        [gradient.contiguous()],
        [mean],
        [square],
        [],
        [step],
        fused=True,
        amsgrad=False,
        beta1=beta1,
        beta2=beta2,
        lr=update.rate,
        weight_decay=0.0,
        eps=eps,
        maximize=False,
    )


@torch.no_grad()
def accumulate(signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor) -> None:
    """Add the norms of the signal of the splats that were seen; they are counted (``kernels/densify_stats.py``)."""
    seen = radii > 0
    zero = torch.zeros_like(signed)
    signed += torch.where(seen, torch.linalg.vector_norm(signal[:, :2], dim=1), zero)
    if signal.shape[1] == 4:
        absolute += torch.where(seen, torch.linalg.vector_norm(signal[:, 2:], dim=1), zero)
    count += seen


def finite(tensor: Tensor) -> bool:
    """Whether all of a tensor is finite: a sum costs one pass, and cannot be finite if a term is not.

    On the CPU numpy sums: it wakes no threads, which costs more than the sum where cores are busy.
    """
    detached = tensor.detach()
    if detached.device.type != "cpu":
        return bool(torch.isfinite(detached.sum()))
    with np.errstate(all="ignore"):
        return bool(np.isfinite(detached.numpy().sum()))


def first_not_finite(tensors: Sequence[Tensor]) -> int | None:
    """Return the number of the first tensor that holds a NaN or an infinity, None if all are finite."""
    return next((number for number, tensor in enumerate(tensors) if not finite(tensor)), None)
