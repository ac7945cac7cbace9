"""The update of an attribute in an Adam step; rows that are not trained are not written."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gs2d.errors import ShapeError


@dataclass(frozen=True, eq=False)
class AdamUpdate:
    """The update of one attribute in an Adam step.

    ``parameter``, ``mean`` and ``square`` [N, ...] float32 are contiguous and changed in place. The gradient has their
    shape; if it is ``compact``, it has one row for each of ``rows``.
    """

    parameter: Tensor
    mean: Tensor
    square: Tensor
    gradient: Tensor
    rate: float
    step: float  # number for the bias correction, 1 in the first step; fractional if steps had different lengths
    trained: Tensor | None = None  # [N] bool; rows that are False are not written, and their gradients are not read
    rows: Tensor | None = None  # [M] int64, updates only these, each once; instead of ``trained``
    compact: bool = False


def check_update(update: AdamUpdate) -> None:
    """Raise ShapeError unless the tensors have matching shapes and types."""
    parameter = update.parameter
    for name in ("mean", "square", *(() if update.compact else ("gradient",))):
        if getattr(update, name).shape != parameter.shape:
            raise ShapeError(f"{name} must be {list(parameter.shape)}, got {list(getattr(update, name).shape)}")
    for name in ("parameter", "mean", "square"):
        if not getattr(update, name).is_contiguous():
            raise ShapeError(f"{name} must be contiguous to be changed in place")
    trained, rows = update.trained, update.rows
    if trained is not None and rows is not None:
        raise ShapeError("an AdamUpdate takes either trained or rows, got both")
    if trained is not None and (trained.dtype != torch.bool or trained.shape != parameter.shape[:1]):
        raise ShapeError(f"trained must be bool [{len(parameter)}], got {trained.dtype} {list(trained.shape)}")
    if rows is not None and (rows.dtype != torch.int64 or rows.dim() != 1):
        raise ShapeError(f"rows must be int64 [M], got {rows.dtype} {list(rows.shape)}")
    if update.compact and rows is None:
        raise ShapeError("a compact gradient needs rows, the parameter row of each gradient row; got none")
    if update.compact and rows is not None and update.gradient.shape != (len(rows), *parameter.shape[1:]):
        raise ShapeError(
            f"a compact gradient must be {[len(rows), *parameter.shape[1:]]}, got {list(update.gradient.shape)}"
        )


def bias_corrections(rate: float, step: float, beta1: float, beta2: float) -> tuple[float, float]:
    """Return rate / (1 - beta1^t) and sqrt(1 - beta2^t) at step t."""
    return rate / (1 - beta1**step), math.sqrt(1 - beta2**step)
