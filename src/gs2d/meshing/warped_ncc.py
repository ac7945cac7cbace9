"""Compare images that are warped through a mesh, and differentiate by the positions of its vertices.

The pixel y of a view sees the mesh at depth z(y). Its neighbour shows this point at a grey value b(y), interpolated
bilinearly; a(y) is the grey value of the view. Around each pixel x, the normalised cross-correlation of the visible
pixels of a window compares a and b, and the energy is

    E = sum over x of w(x) (1 - NCC(x)),    w = trust x texture,

where ``trust`` rises from 0 at ``poor`` to 1 at ``good`` (occlusions, reflections and moving things have none) and
``texture`` is v / (v + ``texture``), v the smaller variance. Weights are constant in the derivative. Formulas:
docs/math.md, "Mesh refinement"; code: ``kernels/cpu/refine.cpp``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, uniform_filter

from gs2d.core.camera import Camera
from gs2d.kernels.library import Library
from gs2d.kernels.native_refine import (
    PLANES,
    VISIBLE,
    WARPED,
    GatherArguments,
    MatchArguments,
    draw_on_cpu,
    gather_on_cpu,
    lens_of,
    match_on_cpu,
)
from gs2d.meshing.raycast import NEAR, outlines

OUTLINE = 2  # px on both sides of an outline that are ignored
ENOUGH = 0.5  # fraction of a window that must be visible in both images
SPAN = 0.03  # of the width, radius of the windows in which neighbours are compared by brightness
FAINT = 0.02  # mean weight there, below which a neighbour is ignored
TINY = 1e-12
DARK = 0.02  # grey value below which the brightness of two images is not compared


@dataclass(frozen=True)
class MatchSettings:
    """How two images are compared."""

    radius: int = 2  # px: a window has 2 radius + 1 pixels a side
    texture: float = 2e-4  # variance of grey in [0, 1] that counts as noise
    poor: float = 0.5  # the trust in a window rises from 0 to 1 between these NCCs
    good: float = 0.9
    occluded: float = 0.01  # A point is visible in the neighbour if its depth there differs by less than this fraction.
    grazing: float = 0.2  # cosine between ray and face below which a pixel moves nothing


@dataclass(frozen=True, eq=False)
class GreyImage:
    """A photograph in grey."""

    camera: Camera
    grey: np.ndarray  # [H, W] float, in [0, 1]
    usable: np.ndarray | None = None  # [H, W] bool, False for pixels to ignore


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """A mesh in an image."""

    face: np.ndarray  # [H, W] int32: the nearest face at each pixel centre; -1 without one
    depth: np.ndarray  # [H, W] float, world units; 0 without a face

    def inner(self, focal: float) -> np.ndarray:
        """Return the pixels [H, W] that show the surface away from outlines, where photographs mix two surfaces."""
        edge = (self.depth <= 0) | outlines(self.depth, focal)
        return ~binary_dilation(edge, np.ones((3, 3), bool), iterations=OUTLINE)


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh whose vertices move along unit normals."""

    vertices: np.ndarray  # [P, 3] float64 world units
    faces: np.ndarray  # [F, 3] int32
    normals: np.ndarray  # [P, 3] float64


@dataclass(frozen=True, eq=False)
class Pull:
    """Derivatives of the energy, by the depth of each pixel or by the distance of vertices along normals."""

    gradient: np.ndarray  # [H, W] or [P] float, by world units
    curvature: np.ndarray  # by their square
    sums: np.ndarray  # [2] float64 of w (1 - NCC) and of w; of pixels alone

    @classmethod
    def zeros(cls, shape: int | tuple[int, ...], dtype: np.dtype[Any] | type | str = np.float64) -> Pull:
        """Return zeros for pixels [H, W], or for a number of vertices."""
        return cls(np.zeros(shape, dtype), np.zeros(shape, dtype), np.zeros(2))


def draw_mesh(vertices: np.ndarray, faces: np.ndarray, camera: Camera, library: Library) -> DrawnMesh:
    """Draw the depth of a mesh of vertices [P, 3] float64 (world units) and faces [F, 3] int32."""
    return DrawnMesh(*draw_on_cpu(library, vertices, faces, camera, NEAR))


def match_views(
    view: GreyImage,
    other: GreyImage,
    depth: np.ndarray,
    other_depth: np.ndarray,
    settings: MatchSettings,
    into: Pull,
    library: Library,
) -> np.ndarray:
    """Compare a view with a neighbour and add the derivatives by the depth of its pixels to ``into``.

    ``depth`` [H, W] and ``other_depth`` [h, w] are the depth of the mesh in both, world units, 0 without a surface. The
    arrays have the precision of the library. Returns the workspace [7, H, W], with the warped neighbour at ``WARPED``
    and where it is visible at ``VISIBLE``.
    """
    motion = other.camera.T_cam_world @ np.linalg.inv(view.camera.T_cam_world)
    dtype = f"f{library.dtype.itemsize}"
    planes = np.empty((PLANES, *depth.shape), dtype)
    arrays = {
        "grey": np.ascontiguousarray(view.grey, dtype),
        "source": np.ascontiguousarray(other.grey, dtype),
        "usable": None if view.usable is None else np.ascontiguousarray(view.usable, np.uint8),
        "source_usable": None if other.usable is None else np.ascontiguousarray(other.usable, np.uint8),
        "depth": np.ascontiguousarray(depth, dtype),
        "source_depth": np.ascontiguousarray(other_depth, dtype),
        "planes": planes,
        "gradient": into.gradient,
        "curvature": into.curvature,
        "sums": into.sums,
    }
    arguments = MatchArguments(
        width=view.camera.width,
        height=view.camera.height,
        source_width=other.camera.width,
        source_height=other.camera.height,
        radius=settings.radius,
        lens=lens_of(view.camera),
        source_lens=lens_of(other.camera),
        motion=(ctypes.c_double * 12)(*motion[:3].ravel()),
        **{name: getattr(settings, name) for name in ("texture", "poor", "good", "occluded")},
        **{name: None if array is None else array.ctypes.data for name, array in arrays.items()},
    )
    match_on_cpu(library, arguments)
    return planes


def brightness_share(
    view: GreyImage,
    depth: np.ndarray,
    neighbours: Sequence[tuple[GreyImage, np.ndarray]],
    settings: MatchSettings,
    library: Library,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which share of the difference between an image and its neighbours is brightness.

    Around each pixel, d is the difference of the mean grey values after one gain for the whole image, and v the sum of
    both variances. The share d^2 / (d^2 + v) is small on matt surfaces. Where it is large, brightness depends on the
    direction of view: a reflection, whose texture is not on the surface. Of the means over ``SPAN``, the lower median
    over the neighbours counts, because people who walk by are brighter or darker in some of them only.

    ``neighbours`` are other images with the depth of the surface in them; depths (world units) are 0 without a surface.
    Returns share, weight and compared, [H, W] float64. The weight is that of texture in :func:`match_views`, 0 where
    the images cannot be compared; ``compared`` is the part of the neighbours that can be.
    """
    side = 2 * round(SPAN * depth.shape[1]) + 1
    shares, weights, compared = [], [], np.zeros(depth.shape)
    for other, other_depth in neighbours:
        share, weight = _share(view, other, depth, other_depth, settings, library)
        compared += weight > 0
        mean_weight = uniform_filter(weight, side)
        mean = uniform_filter(share * weight, side) / np.maximum(mean_weight, TINY)
        shares.append(np.where(mean_weight > FAINT, mean, np.inf))
        weights.append(mean_weight)
    if not shares:
        return compared, compared, compared
    order = np.argsort(shares, axis=0)
    valid = np.isfinite(shares).sum(axis=0)
    middle = np.take_along_axis(order, np.maximum(valid - 1, 0)[None] // 2, axis=0)
    share, weight = (np.take_along_axis(np.stack(values), middle, axis=0)[0] for values in (shares, weights))
    return np.where(valid > 0, share, 0.0), np.where(valid > 0, weight, 0.0), compared / len(shares)


def _share(
    view: GreyImage,
    other: GreyImage,
    depth: np.ndarray,
    other_depth: np.ndarray,
    settings: MatchSettings,
    library: Library,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of brightness [H, W] of one pair and its weight, 0 where they cannot be compared."""
    into = Pull.zeros(depth.shape, f"f{library.dtype.itemsize}")
    planes = match_views(view, other, depth, other_depth, settings, into, library)
    visible = planes[VISIBLE] > 0
    visibility = visible.astype(np.float64)
    a, b = view.grey * visibility, np.asarray(planes[WARPED], np.float64)
    n, sum_a, sum_b, aa, bb = (_sums(k, settings.radius) for k in (visibility, a, b, a * a, b * b))
    enough = visible & (n >= ENOUGH * (2 * settings.radius + 1) ** 2)
    n = np.maximum(n, 1.0)
    mean_a, mean_b = sum_a / n, sum_b / n
    lit = enough & (mean_a > DARK) & (mean_b > DARK)
    gain = float(np.exp(np.median(np.log(mean_a[lit] / mean_b[lit])))) if lit.any() else 1.0
    var_a = np.maximum(aa / n - mean_a**2, 0.0)
    var_b = np.maximum(bb / n - mean_b**2, 0.0) * gain**2
    weaker = np.minimum(var_a, var_b)
    brighter = (mean_a - gain * mean_b) ** 2
    share = brighter / np.maximum(brighter + var_a + var_b, TINY)
    return share, np.where(enough, np.maximum(weaker / (weaker + settings.texture), TINY), 0.0)


def gather_vertices(
    surface: Surface,
    camera: Camera,
    face: np.ndarray,
    pull: Pull,
    into: Pull,
    settings: MatchSettings,
    library: Library,
) -> None:
    """Add the derivatives of the pixels of a view to the vertices of their faces (``face`` of :class:`DrawnMesh`).

    A vertex k that moves by s along its normal n_k moves the depth of a pixel of the face with normal m by share_k (m .
    n_k) / (m . ray) s.
    """
    local = np.ascontiguousarray(surface.vertices @ camera.rotation.T + camera.T_cam_world[:3, 3])
    normals = np.ascontiguousarray(surface.normals @ camera.rotation.T)
    arrays = {
        "local": local,
        "normals": normals,
        "corners": np.ascontiguousarray(surface.faces, np.int32),
        "face": np.ascontiguousarray(face, np.int32),
        "gradient": pull.gradient,
        "curvature": pull.curvature,
        "by_vertex": into.gradient,
        "bend_by_vertex": into.curvature,
    }
    arguments = GatherArguments(
        width=camera.width,
        height=camera.height,
        lens=lens_of(camera),
        grazing=settings.grazing,
        **{name: array.ctypes.data for name, array in arrays.items()},
    )
    gather_on_cpu(library, arguments)


def _sums(values: np.ndarray, radius: int) -> np.ndarray:
    """Return the sums over windows, with zeros beyond the border."""
    side = 2 * radius + 1
    return np.asarray(uniform_filter(values, side, np.float64, mode="constant") * side**2)
