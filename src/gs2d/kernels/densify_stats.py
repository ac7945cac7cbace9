"""Adds the densification signal of a view: the native form of ``torch_kernels.accumulate``."""

from __future__ import annotations

import ctypes

from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError
from gs2d.kernels.library import Library, ready_library

__all__ = ["accumulate"]


def accumulate(
    signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor, *, library: Library | None = None
) -> None:
    """Add the norms of the signal of the splats that were seen; they are counted.

    Parameters
    ----------
    signed, absolute, count : Tensor [N]
        Contiguous; changed in place. ``absolute`` only with four columns.
    signal : Tensor [N, 2] or [N, 4]
        Gradient of the screen probe: signed in columns 0:2, absolute in 2:4.
    radii : Tensor [N] px
        Splats with radius 0 are left alone.
    library : Library, optional

    Raises
    ------
    ShapeError
        Shapes that differ, or another dtype or device than the library takes.
    """
    library = library or ready_library()
    columns = 4 if signal.dim() == 2 and signal.shape[1] == 4 else 2
    written = {"signed": signed, "absolute": absolute, "count": count}
    check_shapes(
        {"signal": (signal, f"N {columns}"), "radii": (radii, "N")} | {k: (t, "N") for k, t in written.items()}
    )
    for name, tensor in (written | {"signal": signal, "radii": radii}).items():
        if not tensor.is_cpu or tensor.dtype != library.dtype:
            raise ShapeError(f"{name} must be {library.dtype} on the cpu, got {tensor.dtype} on {tensor.device}")
        if name in written and not tensor.is_contiguous():
            raise ShapeError(f"{name} must be contiguous to be changed in place")
    signal, radii = signal.detach().contiguous(), radii.detach().contiguous()
    pointer = ctypes.c_void_p
    function = library.function(
        "gs2d_accumulate_signal", None, (pointer, ctypes.c_int, pointer, ctypes.c_int64, pointer, pointer, pointer)
    )
    pointers = (tensor.data_ptr() for tensor in written.values())
    function(signal.data_ptr(), columns, radii.data_ptr(), len(radii), *pointers)
