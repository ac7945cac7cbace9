"""The native vignetting and response of a camera; ``gs2d.render.camera_response`` has the same in torch."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from gs2d.kernels.library import Library
from gs2d.render.exposure_native import plain_tensors

__all__ = ["gradients", "shown"]


class _Shown(ctypes.Structure):
    """``struct Shown`` of kernels/cpu/photometry.cpp."""

    _fields_ = (
        ("color", ctypes.c_void_p),
        ("coverage", ctypes.c_void_p),
        ("squares", ctypes.c_void_p),
        ("pixels", ctypes.c_int64),
        ("falloff", ctypes.c_double * 3),
        ("shift", ctypes.c_double),
        ("background", ctypes.c_double * 3),
    )


def _struct(tensors: Sequence[Tensor | None], numbers: Tensor, background: Tensor | None) -> _Shown:
    color = tensors[0]
    assert color is not None
    *falloff, shift = numbers.detach().tolist()
    behind = (0.0, 0.0, 0.0) if background is None else tuple(background.tolist())
    return _Shown(
        *(None if tensor is None else tensor.data_ptr() for tensor in tensors),
        color.numel() // 3,
        (ctypes.c_double * 3)(*falloff),
        shift,
        (ctypes.c_double * 3)(*behind),
    )


def shown(
    library: Library,
    color: Tensor,
    numbers: Tensor,
    squares: Tensor | None,
    coverage: Tensor | None,
    background: Tensor | None,
) -> Tensor:
    """Return the picture; arguments as of ``gs2d.render.camera_response.show``.

    Raises
    ------
    ShapeError
        If a tensor has another dtype, or is not on the CPU.
    """
    tensors = plain_tensors(library, color=color, coverage=coverage, squares=squares)
    out = torch.empty_like(color, memory_format=torch.contiguous_format)
    given = _struct(tensors, numbers, background)
    library.function("gs2d_shown", None, (ctypes.c_void_p,) * 2)(ctypes.byref(given), out.data_ptr())
    return out


def gradients(
    library: Library,
    upstream: Tensor,
    color: Tensor,
    numbers: Tensor,
    squares: Tensor | None,
    coverage: Tensor | None,
    background: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Those of ``color`` [H, W, 3] and ``numbers`` [4]."""
    above, *tensors = plain_tensors(library, upstream=upstream, color=color, coverage=coverage, squares=squares)
    assert above is not None
    to_color, sums = torch.empty_like(above), (ctypes.c_double * 4)()
    given = _struct(tensors, numbers, background)
    function = library.function("gs2d_shown_vjp", ctypes.c_int, (ctypes.c_void_p,) * 4)
    if function(ctypes.byref(given), above.data_ptr(), to_color.data_ptr(), sums) != 0:
        raise MemoryError("no memory for the sums of a vignetting's gradient")
    return to_color, torch.tensor(list(sums), dtype=torch.float64).to(numbers.dtype)
