"""Adam on a GPU: all attributes in one launch; rows that are not trained are not written."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gs2d.errors import ShapeError
from gs2d.kernels.adam_update import AdamUpdate, bias_corrections, check_update
from gs2d.kernels.cuda.cuda_losses import ready
from gs2d.kernels.cuda.kernel_arguments import fill, work_of

if TYPE_CHECKING:
    from gs2d.kernels.cuda.launch import Launcher, Work

BLOCK_ELEMENTS = 512  # adam.cu


@torch.no_grad()
def adam_step(
    updates: Sequence[AdamUpdate],
    *,
    beta1: float,
    beta2: float,
    eps: float,
    launcher: Launcher,
    skip: Tensor | None = None,
) -> None:
    """Run one Adam step on up to six attributes, in place, in one launch; the arithmetic of torch's fused Adam.

    If ``skip`` [] int32 on the device is not 0, nothing is changed. Raises ShapeError if a tensor has another shape,
    dtype or device.
    """
    if len(updates) > 6:
        raise ShapeError(f"adam_step takes up to 6 attributes, got {len(updates)}")
    plain = []  # keeps the tensors behind the pointers
    for update in updates:
        check_update(update)
        *_, gradient = ready(
            parameter=update.parameter, mean=update.mean, square=update.square, gradient=update.gradient
        )
        masks = {name: getattr(update, name) for name in ("trained", "rows")}
        masks = {name: None if tensor is None else tensor.contiguous() for name, tensor in masks.items()}
        plain.append(replace(update, gradient=gradient, **masks))
    work = adam_work(plain, beta1=beta1, beta2=beta2, eps=eps, skip=skip)
    launcher.launch(work.name, work.blocks, work.threads, work.arguments)


def adam_work(updates: Sequence[AdamUpdate], *, beta1: float, beta2: float, eps: float, skip: Tensor | None) -> Work:
    """Return the launch of an Adam step on contiguous tensors; it has a slot for each attribute with elements."""
    work = work_of("adam_step", 0, weight_1=1 - beta1, beta2=beta2, weight_2=1 - beta2, eps=eps, skip=skip)
    for update in updates:
        columns = math.prod(update.parameter.shape[1:])
        elements = columns * len(update.parameter if update.rows is None else update.rows)
        if elements == 0:
            continue
        slot = work.arguments.attributes[work.arguments.count]
        names = ("parameter", "mean", "square", "gradient", "trained", "rows")
        fill(slot, **{name: getattr(update, name) for name in names})
        slot.elements, slot.first_block, slot.columns = elements, work.blocks, columns
        slot.compact = int(update.compact)
        slot.step_size, slot.root_2 = bias_corrections(update.rate, update.step, beta1, beta2)
        work.arguments.count += 1
        work.blocks += -(-elements // BLOCK_ELEMENTS)
    return work
