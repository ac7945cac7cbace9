"""The native colour transform of a photograph; ``gs2d.render.exposure_transform`` has the same in torch."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from gs2d.errors import ShapeError
from gs2d.kernels.library import Library

__all__ = ["exposed", "gradients"]


class _Image(ctypes.Structure):
    """``struct Picture`` of kernels/cpu/exposure.cpp."""

    _fields_ = (
        ("color", ctypes.c_void_p),
        ("coverage", ctypes.c_void_p),
        ("pixels", ctypes.c_int64),
        ("transform", ctypes.c_double * 12),
        ("background", ctypes.c_double * 3),
    )


def plain_tensors(library: Library, **tensors: Tensor | None) -> list[Tensor | None]:
    """Return the tensors, contiguous, or ShapeError for one that native code cannot read."""
    for name, tensor in tensors.items():
        if tensor is not None and (not tensor.is_cpu or tensor.dtype != library.dtype):
            raise ShapeError(f"{name} must be {library.dtype} on the cpu, got {tensor.dtype} on {tensor.device}")
    return [None if tensor is None else tensor.detach().contiguous() for tensor in tensors.values()]


def _image(color: Tensor, transform: Tensor, coverage: Tensor | None, background: Tensor | None) -> _Image:
    behind = (0.0, 0.0, 0.0) if coverage is None or background is None else tuple(background.tolist())
    return _Image(
        color.data_ptr(),
        None if coverage is None else coverage.data_ptr(),
        color.numel() // 3,
        (ctypes.c_double * 12)(*transform.detach().flatten().tolist()),
        (ctypes.c_double * 3)(*behind),
    )


def exposed(
    library: Library, color: Tensor, transform: Tensor, coverage: Tensor | None, background: Tensor | None
) -> Tensor:
    """Return the image; arguments as of ``gs2d.render.exposure_transform.expose``.

    Raises
    ------
    ShapeError
        If a tensor has another dtype, or is not on the CPU.
    """
    plain, cover = plain_tensors(library, color=color, coverage=coverage)
    assert plain is not None
    out = torch.empty_like(plain)
    image = _image(plain, transform, cover, background)
    function = library.function("gs2d_expose", None, (ctypes.c_void_p,) * 4)
    function(ctypes.byref(image), None, out.data_ptr(), None)
    return out


def gradients(
    library: Library,
    upstream: Tensor,
    color: Tensor,
    transform: Tensor,
    coverage: Tensor | None,
    background: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Those of ``color`` [H, W, 3] and ``transform`` [3, 4]."""
    given, plain, cover = plain_tensors(library, upstream=upstream, color=color, coverage=coverage)
    assert given is not None
    assert plain is not None
    to_color, sums = torch.empty_like(plain), (ctypes.c_double * 12)()
    image = _image(plain, transform, cover, background)
    function = library.function("gs2d_expose_vjp", ctypes.c_int, (ctypes.c_void_p,) * 5)
    if function(ctypes.byref(image), None, given.data_ptr(), to_color.data_ptr(), sums) != 0:
        raise MemoryError("no memory for the sums of an exposure's gradient")
    return to_color, torch.tensor(list(sums), dtype=torch.float64).reshape(3, 4).to(transform.dtype)
