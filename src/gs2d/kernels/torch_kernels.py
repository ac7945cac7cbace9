"""The training kernels besides rendering, in plain torch: the reference for the native ones, and the fallback."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.optim.adam import adam

from gs2d.kernels.adam_update import AdamUpdate


@torch.no_grad()
def adam_step(updates: Sequence[AdamUpdate], *, beta1: float, beta2: float, eps: float) -> None:
    """Run one Adam step on several attributes, in place, by torch's fused Adam; untrained rows are not written."""
    options: dict[str, Any] = {"fused": True, "amsgrad": False, "maximize": False, "weight_decay": 0.0}
    options |= {"beta1": beta1, "beta2": beta2, "eps": eps}
    for update in updates:
        whole = (update.parameter, update.mean, update.square)
        rows = update.rows if update.trained is None else update.trained.nonzero().squeeze(1)  # [M]
        if rows is not None and len(rows) == 0:
            continue
        parameter, mean, square = whole if rows is None else (tensor[rows] for tensor in whole)
        gradient = update.gradient if rows is None or update.compact else update.gradient[rows]
        step = torch.tensor(float(update.step - 1), device=parameter.device)  # adam() adds one
        adam([parameter], [gradient.contiguous()], [mean], [square], [], [step], lr=update.rate, **options)
        if rows is not None:
            for tensor, part in zip(whole, (parameter, mean, square), strict=True):
                tensor[rows] = part


@torch.no_grad()
def accumulate(signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor) -> None:
    """Add the norms of the signal of visible splats and count these splats (``Backend.accumulate``)."""
    visible = radii > 0
    zero = torch.zeros_like(signed)
    signed += torch.where(visible, torch.linalg.vector_norm(signal[:, :2], dim=1), zero)
    if signal.shape[1] == 4:
        absolute += torch.where(visible, torch.linalg.vector_norm(signal[:, 2:], dim=1), zero)
    count += visible


def finite(tensor: Tensor) -> bool:
    """Whether all elements of a tensor are finite, judged by their sum: it is not finite if an element is not.

    On the CPU numpy computes the sum: waking threads would cost more than the sum on a busy machine.
    """
    detached = tensor.detach()
    if detached.device.type != "cpu":
        return bool(torch.isfinite(detached.sum()))
    with np.errstate(all="ignore"):
        return bool(np.isfinite(detached.numpy().sum()))


def first_not_finite(tensors: Sequence[Tensor]) -> int | None:
    """Return the index of the first tensor with a NaN or an infinity, None if all are finite."""
    return next((number for number, tensor in enumerate(tensors) if not finite(tensor)), None)
