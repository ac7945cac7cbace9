"""Adam on a GPU: all attributes in one launch; rows that are not trained are not written."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gs2d.errors import ShapeError
from gs2d.kernels.cuda.cuda_losses import ready
from gs2d.kernels.cuda.kernel_arguments import arguments_of, fill
from gs2d.kernels.native_adam import AdamUpdate, bias_corrections, check_update

if TYPE_CHECKING:
    from gs2d.kernels.cuda.launch import Launcher

__all__ = ["AdamUpdate", "adam_step"]

THREADS = 128
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

    Parameters
    ----------
    updates : sequence of AdamUpdate
    beta1, beta2, eps : float
    launcher : Launcher
        Launcher of the tensors' device.
    skip : Tensor [] int32, optional
        On the device; if it is not 0, nothing is changed.

    Raises
    ------
    ShapeError
        If a tensor has another shape, dtype or device.
    """
    if len(updates) > 6:
        raise ShapeError(f"adam_step takes up to 6 attributes, got {len(updates)}")
    arguments = arguments_of("adam_step", weight_1=1 - beta1, beta2=beta2, weight_2=1 - beta2, eps=eps, skip=skip)
    alive = []  # tensors behind the pointers
    blocks = 0
    for update in updates:
        check_update(update)
        tensors = {"parameter": update.parameter, "mean": update.mean, "square": update.square}
        *_, gradient = ready(**tensors, gradient=update.gradient)
        trained = None if update.trained is None else update.trained.contiguous()
        rows = None if update.rows is None else update.rows.contiguous()
        columns = math.prod(update.parameter.shape[1:])
        elements = columns * (len(update.parameter) if rows is None else len(rows))
        if elements == 0:
            continue
        slot = arguments.attributes[arguments.count]
        fill(slot, **tensors, gradient=gradient, trained=trained, rows=rows)
        slot.elements, slot.first_block, slot.columns, slot.compact = elements, blocks, columns, int(update.compact)
        slot.step_size, slot.root_2 = bias_corrections(update.rate, update.step, beta1, beta2)
        arguments.count += 1
        blocks += -(-elements // BLOCK_ELEMENTS)
        alive += [gradient, trained, rows]
    if blocks > 0:
        launcher.launch("adam_step", blocks, THREADS, arguments)
    del alive
