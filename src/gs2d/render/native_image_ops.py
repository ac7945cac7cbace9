"""Native exposure and pose gradient (``kernels/cpu``: exposure.cpp, camera.cpp).

``exposure_transform`` and ``pose_gradient`` have the same formulas in torch. All functions raise
ShapeError for a tensor that is not on the CPU or of another dtype than the library's. Their results do not depend on
the number of threads.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError
from gs2d.kernels.c_structures import filled, structure
from gs2d.kernels.library import Library

__all__ = ["Wrench", "expose", "expose_vjp", "wrench"]

POINTER = ctypes.c_void_p
Wrench = tuple[Tensor, Tensor]
"""Derivatives [3] by a translation and by a rotation of the scene about the camera centre, world axes, float64."""


def _sums(library: Library, name: str, count: int, *arguments: Any) -> Tensor:
    """Call an exported function that writes ``count`` sums and returns whether memory was short."""
    sums = (ctypes.c_double * count)()
    if library.function(name, ctypes.c_int, [POINTER] * (len(arguments) + 1))(*arguments, sums) != 0:
        raise MemoryError(f"{name} could not allocate its sums")
    return torch.tensor(list(sums), dtype=torch.float64)


def _exposure_image(color: Tensor, transform: Tensor, coverage: Tensor | None, background: Tensor | None) -> Any:
    picture = filled(
        structure("Picture", "cpu/exposure.cpp"), color=color, coverage=coverage, pixels=color.numel() // 3
    )
    picture.transform = tuple(transform.detach().flatten().tolist())
    if coverage is not None and background is not None:
        picture.background = tuple(background.tolist())
    return picture


def expose(
    library: Library, color: Tensor, transform: Tensor, coverage: Tensor | None, background: Tensor | None
) -> Tensor:
    """Return the image; arguments as for ``gs2d.render.exposure_transform.expose``."""
    color, coverage = library.arrays(color=color, coverage=coverage)
    out = torch.empty_like(color)
    image = _exposure_image(color, transform, coverage, background)
    library.function("gs2d_expose", None, [POINTER] * 4)(ctypes.byref(image), None, out.data_ptr(), None)
    return out


def expose_vjp(
    library: Library,
    upstream: Tensor,
    color: Tensor,
    transform: Tensor,
    coverage: Tensor | None,
    background: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Return the gradients of ``color`` [H, W, 3] and ``transform`` [3, 4]."""
    upstream, color, coverage = library.arrays(upstream=upstream, color=color, coverage=coverage)
    to_color = torch.empty_like(color)
    image = _exposure_image(color, transform, coverage, background)
    pointers = (ctypes.byref(image), None, upstream.data_ptr(), to_color.data_ptr())
    return to_color, _sums(library, "gs2d_expose_vjp", 12, *pointers).reshape(3, 4).to(transform.dtype)


def wrench(
    library: Library,
    center: Tensor,
    points: Tensor,
    to_points: Tensor,
    quats: tuple[Tensor, Tensor] | None = None,
    colors: tuple[Tensor, Tensor, int] | None = None,
) -> Wrench:
    """Return the derivatives by a rigid motion of the scene; rows that are not finite contribute nothing.

    Parameters
    ----------
    library : Library
    center : Tensor [3]
        Centre of the rotation.
    points, to_points : Tensor [N, 3]
        Splat centres, or vectors that rotate, and their gradients.
    quats : (Tensor [N, 4], Tensor [N, 4]), optional
        Quaternions and their gradients.
    colors : (Tensor [N, K-1, 3], Tensor [N, 1, 3], int), optional
        ``shN``, the gradients of ``sh0`` and the evaluated degree. Harmonics do not rotate with the scene.
    """
    shapes = {"points": (points, "N 3"), "to_points": (to_points, "N 3")}
    if quats is not None:
        shapes |= {"quats": (quats[0], "N 4"), "to_quats": (quats[1], "N 4")}
    degree = 0 if colors is None else colors[2]
    if colors is not None and degree > 0:
        shapes |= {"shN": (colors[0], "N K 3"), "to_sh0": (colors[1], "N 1 3")}
    sizes = check_shapes(shapes)
    if degree > 0 and (degree + 1) ** 2 - 1 > sizes["K"]:
        raise ShapeError(f"shN must hold degree {degree}, got {sizes['K']} coefficients")
    tensors = dict(zip(shapes, library.arrays(**{name: tensor for name, (tensor, _) in shapes.items()}), strict=True))
    rows = {"count": sizes["N"], "sh_rest": sizes.get("K", 0), "degree": degree}
    moved = filled(structure("Moved", "cpu/camera.cpp"), **rows, **tensors, center=tuple(center.tolist()))
    force, torque = _sums(library, "gs2d_camera_wrench", 6, ctypes.byref(moved)).view(2, 3)
    return force, torque
