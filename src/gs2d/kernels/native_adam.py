"""Adam on the CPU: all attributes in one native call; rows that are not trained are not written."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gs2d.errors import ShapeError
from gs2d.kernels.c_structures import fill, structure
from gs2d.kernels.library import Library, ready_library


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


@torch.no_grad()
def adam_step(
    updates: Sequence[AdamUpdate], *, beta1: float, beta2: float, eps: float, library: Library | None = None
) -> None:
    """Run one Adam step on several attributes, in place; equal to torch's fused Adam to rounding.

    Tensors are on the CPU and have the library's dtype. The bits do not depend on the number of threads. Raises
    ShapeError if a tensor has another shape, dtype or device, or a row index is out of range.
    """
    library = library or ready_library()
    attributes = (structure("AdamAttribute", "cpu") * len(updates))()
    alive = []  # tensors behind the pointers
    for slot, update in zip(attributes, updates, strict=True):
        check_update(update)
        named = {name: getattr(update, name) for name in ("parameter", "mean", "square", "gradient")}
        tensors = library.arrays(**named)
        fill(slot, **dict(zip(named, tensors, strict=True)))
        rows = update.rows if update.trained is None else update.trained.nonzero().squeeze(1)
        if rows is not None:
            if not rows.is_cpu:
                raise ShapeError(f"rows must be on the cpu, got {rows.device}")
            rows = rows.contiguous()
            slot.rows = rows.data_ptr()
        slot.height, slot.columns = len(update.parameter), max(1, math.prod(update.parameter.shape[1:]))
        slot.count = 0 if update.parameter.numel() == 0 else slot.height if rows is None else len(rows)
        slot.compact = update.compact
        slot.step_size, slot.root_2 = bias_corrections(update.rate, update.step, beta1, beta2)
        alive += [*tensors, rows]
    if library.call("gs2d_adam", attributes, len(updates), beta1, beta2, eps) != 0:
        raise ShapeError("rows must be row indices of the parameter, got an index out of range")
    del alive


def first_not_finite(tensors: Sequence[Tensor], *, library: Library | None = None) -> int | None:
    """Return the index of the first tensor with a NaN or an infinity, None if all are finite.

    Raises ShapeError if a tensor is not on the CPU or has another dtype than the library.
    """
    library = library or ready_library()
    plain = library.arrays(**{f"tensor {number}": tensor for number, tensor in enumerate(tensors)})
    count = len(plain)
    pointers = (ctypes.c_void_p * count)(*(tensor.data_ptr() for tensor in plain))
    sizes = (ctypes.c_int64 * count)(*(tensor.numel() for tensor in plain))
    first = int(library.call("gs2d_first_not_finite", pointers, sizes, count))
    return None if first == count else first
