"""Sums over splats, or pixels, that a camera's gradient is made of (``render.pose_gradient``), in one native call."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError
from gs2d.kernels.library import Library

__all__ = ["Wrench", "wrench"]

Wrench = tuple[Tensor, Tensor]
"""Derivative by a shift [3] and by a turn about the camera's centre [3] of the scene, world axes, float64."""


class _Moved(ctypes.Structure):
    """``struct Moved`` of kernels/cpu/camera.cpp."""

    _fields_ = (
        ("count", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("points", "to_points", "quats", "to_quats", "shN", "to_sh0")),
        ("sh_rest", ctypes.c_int64),
        ("degree", ctypes.c_int64),
        ("center", ctypes.c_double * 3),
    )


def wrench(
    library: Library,
    center: Tensor,
    points: Tensor,
    to_points: Tensor,
    quats: tuple[Tensor, Tensor] | None = None,
    colors: tuple[Tensor, Tensor, int] | None = None,
) -> Wrench:
    """Return what moves the scene, from the gradients of its parts; rows that are not finite count nothing.

    Parameters
    ----------
    library : Library
        Whose dtype the tensors have; they are on the CPU.
    center : Tensor [3]
        About which the scene turns.
    points, to_points : Tensor [N, 3]
        Centres, or vectors that turn, and their gradients.
    quats : (Tensor [N, 4], Tensor [N, 4]), optional
        Quaternions and their gradients.
    colors : (Tensor [N, K-1, 3], Tensor [N, 1, 3], int), optional
        ``shN``, the gradients of ``sh0``, and the degree that was evaluated: what does not turn with the scene.

    Raises
    ------
    ShapeError
        Shapes that do not fit, or a tensor that native code cannot read.
    """
    shapes = {"points": (points, "N 3"), "to_points": (to_points, "N 3")}
    if quats is not None:
        shapes |= {"quats": (quats[0], "N 4"), "to_quats": (quats[1], "N 4")}
    if colors is not None and colors[2] > 0:
        shapes |= {"shN": (colors[0], "N K 3"), "to_sh0": (colors[1], "N 1 3")}
    sizes = check_shapes(shapes)
    degree = 0 if colors is None else colors[2]
    if (degree + 1) ** 2 - 1 > sizes.get("K", 0) and degree > 0:
        raise ShapeError(f"shN must hold degree {degree}, got {sizes['K']} coefficients")
    moved = _Moved(count=sizes["N"], sh_rest=sizes.get("K", 0), degree=degree)
    moved.center[:] = center.tolist()
    alive = []  # what the pointers belong to
    for name, (tensor, _) in shapes.items():
        if not tensor.is_cpu or tensor.dtype != library.dtype:
            raise ShapeError(f"{name} must be {library.dtype} on the cpu, got {tensor.dtype} on {tensor.device}")
        alive.append(tensor.detach().contiguous())
        setattr(moved, name, alive[-1].data_ptr())
    sums = (ctypes.c_double * 6)()
    function = library.function("gs2d_camera_wrench", ctypes.c_int, (ctypes.c_void_p, ctypes.c_void_p))
    if function(ctypes.byref(moved), sums) != 0:
        raise MemoryError("no memory for the sums of a camera's gradient")
    del alive
    force, torque = torch.tensor(list(sums), dtype=torch.float64).view(2, 3)
    return force, torque
