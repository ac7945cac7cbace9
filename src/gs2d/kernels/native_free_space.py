"""Splats in the free space of a photograph, natively; ``training/robust/free_space_maps.py`` has the same in torch."""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import torch
from torch import Tensor

from gs2d.kernels.library import library_for

__all__ = ["SeenSpace", "look_at_free_space"]


class _Arguments(ctypes.Structure):
    """``FreeSpaceArguments`` of cpu/free_space.cpp, with float32 arrays."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("count", "places", "height", "width")),
        *((name, ctypes.c_void_p) for name in ("ends", "reach", "project", "center")),
        ("radius", ctypes.c_float),
        *((name, ctypes.c_void_p) for name in ("limit", "known")),
        ("fraction", ctypes.c_float),
        *((name, ctypes.c_void_p) for name in ("against", "support")),
    )


class SeenSpace(NamedTuple):
    """What an image says about the space before it.

    Attributes
    ----------
    project : Tensor [3, 4] float32
        A place p is at pixel (x, y) and depth z: (x z, y z, z) = project (p, 1).
    center : Tensor [3] float32
        Camera centre, world units.
    limit, known : Tensor [H, W] float32, world units
        What is nearer than ``limit`` is free; ``known`` is the depth of the surface in the image, or infinite.
    radius : float
        Radius of the free ball around the camera, world units.
    fraction : float
        Of the depth, within which a centre lies on the surface.
    """

    project: Tensor
    center: Tensor
    limit: Tensor
    known: Tensor
    radius: float
    fraction: float


def look_at_free_space(ends: Tensor, reach: Tensor, seen: SeenSpace, against: Tensor, support: Tensor) -> bool:
    """Count, for each splat, a photograph that sees through it and one that shows a surface there.

    Parameters
    ----------
    ends : Tensor [P, N, 3] float32, world units
        Places at which a splat is looked at, its centre first.
    reach : Tensor [N] float32, world units
        No place of a splat is farther from its centre.
    seen : SeenSpace
    against, support : Tensor [N] int32
        One is added where any place is free, and where the centre lies on the surface.

    Returns
    -------
    bool
        False without the native library: nothing was done.
    """
    library = library_for(ends)
    if library is None or library.dtype != torch.float32:
        return False
    inputs = {"ends": ends, "reach": reach}
    inputs |= {name: getattr(seen, name) for name in ("project", "center", "limit", "known")}
    given = {name: tensor.contiguous() for name, tensor in inputs.items()}
    height, width = seen.limit.shape
    arguments = _Arguments(
        count=ends.shape[1],
        places=len(ends),
        height=height,
        width=width,
        radius=seen.radius,
        fraction=seen.fraction,
        against=against.data_ptr(),
        support=support.data_ptr(),
        **{name: tensor.data_ptr() for name, tensor in given.items()},
    )
    library.function("gs2d_free_space", None, [ctypes.c_void_p])(ctypes.byref(arguments))
    return True
