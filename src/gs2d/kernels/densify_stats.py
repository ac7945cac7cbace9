"""Native accumulation of the densification signal; ``torch_kernels.accumulate`` has the same in torch."""

from __future__ import annotations

from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError
from gs2d.kernels.library import Library, ready_library


def accumulate(
    signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor, *, library: Library | None = None
) -> None:
    """Add the norms of the signal of visible splats, and count these splats.

    ``signed``, ``absolute`` and ``count`` [N] are contiguous and changed in place, ``absolute`` only if the signal has
    four columns. ``signal`` [N, 2] or [N, 4] is the gradient of the screen probe: signed in columns 0:2, absolute in
    2:4. Splats with radius 0 are skipped. Raises ShapeError if shapes differ, or a tensor has another dtype or device
    than the library.
    """
    library = library or ready_library()
    columns = 4 if signal.dim() == 2 and signal.shape[1] == 4 else 2
    sums = {"signed": signed, "absolute": absolute, "count": count}
    check_shapes({"signal": (signal, f"N {columns}"), "radii": (radii, "N")} | {k: (t, "N") for k, t in sums.items()})
    for name, tensor in sums.items():
        if not tensor.is_contiguous():
            raise ShapeError(f"{name} must be contiguous to be changed in place")
    signal, radii, *changed = library.arrays(signal=signal, radii=radii, **sums)
    library.call("gs2d_accumulate_signal", signal, columns, radii, len(radii), *changed)
