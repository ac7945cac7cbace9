"""Native comparison of image patches of two views, for autograd: gradients are computed in the forward pass.

The formulas are in ``kernels/core/multiview.h``; ``losses.view_pair`` has the same in torch. The bits do not depend on
the number of threads. Backends share everything except a :data:`Run`, which fills rows of numbers for each pixel.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.config.multiview import MultiView
from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError
from gs2d.kernels.library import Library, ready_library

__all__ = ["CompareArguments", "Compared", "compare_on", "compare_views"]

VALUES, GRADIENTS, MOTION, TURN_SHIFT = 2, 5, 21, 12  # rows; motion_gradients has MOTION, then TURN_SHIFT


class CompareArguments(ctypes.Structure):
    """``CompareArguments`` of core/multiview.h."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("count", "width", "height", "source_width", "source_height")),
        *((name, ctypes.c_int64) for name in ("depth_width", "depth_height", "radius")),
        ("lens", ctypes.c_double * 4),
        ("source_lens", ctypes.c_double * 4),
        ("texture", ctypes.c_double),
        ("occluded", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("depth", "normal", "motion", "index", "chosen")),
        *((name, ctypes.c_void_p) for name in ("reference", "source", "clear", "source_depth")),
        *((name, ctypes.c_void_p) for name in ("values", "gradients", "motion_gradients")),
    )


@dataclass(frozen=True, eq=False)
class Compared:
    """Pixels of a view, and the neighbouring view that they are compared with.

    Attributes
    ----------
    index : Tensor [P] int64
        Indices into the flat image, without duplicates where ``chosen``. Their patches lie inside the image, and their
        depth is above 0.
    chosen : Tensor [P] bool
        Pixels to compare.
    reference : Tensor [H, W]
        Grey image of the view.
    source : Tensor [h, w]
        Grey image of the neighbour.
    clear : Tensor [h, w] bool
        Pixels of the neighbour around which a patch may be compared.
    source_depth : Tensor [h', w'] world units
        Depth of the neighbour's whole image, at any resolution; 0 where nothing is hit.
    camera, source_camera : Camera
    settings : MultiView
    """

    index: Tensor
    chosen: Tensor
    reference: Tensor
    source: Tensor
    clear: Tensor
    source_depth: Tensor
    camera: Camera
    source_camera: Camera
    settings: MultiView


Run = Callable[[CompareArguments, dict[str, Tensor | None]], Tensor]
"""Fills the rows "values", "gradients" and "motion_gradients"; returns the sums of the first and the last."""


class _Compare(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, depth: Tensor, normal: Tensor, motion: Tensor, given: Compared, wanted: bool, moves: bool, run: Run
    ) -> tuple[Tensor, Tensor]:
        count = len(given.index)
        tensors: dict[str, Tensor | None] = {
            "depth": depth,
            "normal": normal,
            "motion": motion,
            "index": given.index.contiguous(),
            "chosen": given.chosen.contiguous(),
            "reference": given.reference.contiguous(),
            "source": given.source.contiguous(),
            "clear": given.clear.contiguous(),
            "source_depth": given.source_depth.contiguous(),
            "values": depth.new_empty(VALUES, count),
            "gradients": depth.new_empty(GRADIENTS, count) if wanted else None,
            "motion_gradients": depth.new_empty(MOTION + TURN_SHIFT, count) if moves else None,
        }
        sums = run(_arguments(given), tensors)
        ctx.shape = depth.shape
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(given.index, tensors["gradients"], sums[VALUES:])
        return sums[0].clone(), sums[1].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_photometric: Tensor | None, g_geometric: Tensor | None) -> tuple[Tensor | None, ...]:
        index, rows, motion = ctx.saved_tensors
        height, width = ctx.shape
        g_depth, g_normal, g_motion = rows.new_zeros(height * width), None, motion.new_zeros(min(len(motion), MOTION))
        # No pixel is chosen twice and the others add 0, so the order of a device's additions does not matter.
        if g_photometric is not None:
            by_similarity = g_photometric * rows[:4]
            g_depth.index_add_(0, index, by_similarity[0])
            g_normal = rows.new_zeros(height * width, 3).index_add_(0, index, by_similarity[1:].T)
            g_normal = g_normal.view(height, width, 3)
            g_motion += g_photometric * motion[:MOTION]
        if g_geometric is not None:
            g_depth.index_add_(0, index, g_geometric * rows[4])
            g_motion[:TURN_SHIFT] += g_geometric * motion[MOTION:]
        return g_depth.view(height, width), g_normal, g_motion if len(motion) else None, None, None, None, None


def _arguments(given: Compared) -> CompareArguments:
    camera, source, settings = given.camera, given.source_camera, given.settings
    arguments = CompareArguments(
        count=len(given.index),
        width=camera.width,
        height=camera.height,
        source_width=source.width,
        source_height=source.height,
        depth_width=given.source_depth.shape[1],
        depth_height=given.source_depth.shape[0],
        radius=settings.radius,
        texture=settings.texture,
        occluded=settings.occluded,
    )
    arguments.lens[:] = [camera.fx, camera.fy, camera.cx, camera.cy]
    arguments.source_lens[:] = [source.fx, source.fy, source.cx, source.cy]
    return arguments


def compare_on(depth: Tensor, normal: Tensor, motion: Tensor, given: Compared, run: Run) -> tuple[Tensor, Tensor]:
    """Check shapes and compare the views with the kernel of a backend, as :func:`compare_views` does."""
    images = {"depth": (depth, "H W"), "normal": (normal, "H W 3"), "reference": (given.reference, "H W")}
    pixels = {"index": (given.index, "P"), "chosen": (given.chosen, "P"), "motion": (motion, str(MOTION))}
    there = {
        "source": (given.source, "h w"),
        "clear": (given.clear, "h w"),
        "source_depth": (given.source_depth, "a b"),
    }
    sizes = check_shapes(images | pixels | there)
    for camera, size in ((given.camera, ("H", "W")), (given.source_camera, ("h", "w"))):
        if (camera.height, camera.width) != tuple(sizes[name] for name in size):
            height, width = (sizes[name] for name in size)
            raise ShapeError(f"camera is {camera.width}x{camera.height}, but its image is {width}x{height}")
    differs = torch.is_grad_enabled()
    moves = differs and motion.requires_grad
    wanted = moves or (differs and (depth.requires_grad or normal.requires_grad))
    photometric, geometric = _Compare.apply(
        depth.contiguous(), normal.contiguous(), motion.contiguous(), given, wanted, moves, run
    )
    return photometric, geometric


def compare_views(
    depth: Tensor, normal: Tensor, motion: Tensor, given: Compared, *, library: Library | None = None
) -> tuple[Tensor, Tensor]:
    """Compare pixels of a view with a neighbouring view; differentiable in the first three arguments.

    Parameters
    ----------
    depth : Tensor [H, W] world units
    normal : Tensor [H, W, 3]
        World frame, any length.
    motion : Tensor [21]
        Rotation (row-major) and translation from the view's camera to the neighbour's, then the rotation from the
        world to the view's camera.
    given : Compared
    library : Library, optional
        Default: ``ready_library()``.

    Returns
    -------
    photometric, geometric : Tensor []
        Sums over the valid pixels of ``weight (1 - NCC)`` and ``weight error`` (px).

    Raises
    ------
    ShapeError
        If shapes differ, or a tensor has another dtype or device than the library.
    """
    library = library or ready_library()
    images = {name: getattr(given, name) for name in ("reference", "source", "source_depth")}
    library.arrays(depth=depth, normal=normal, motion=motion, **images)

    def run(arguments: CompareArguments, tensors: dict[str, Tensor | None]) -> Tensor:
        for name, tensor in tensors.items():
            setattr(arguments, name, None if tensor is None else tensor.data_ptr())
        moves = tensors["motion_gradients"] is not None
        sums = torch.empty(VALUES + (MOTION + TURN_SHIFT if moves else 0), dtype=torch.float64)
        call = library.function("gs2d_compare_views", ctypes.c_int, [ctypes.c_void_p] * 2)
        if call(ctypes.byref(arguments), sums.data_ptr()) != 0:
            raise MemoryError("gs2d_compare_views could not allocate its patches")
        return sums.to(library.dtype)

    return compare_on(depth, normal, motion, given, run)
