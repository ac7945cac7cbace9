"""Compare images that are warped through a mesh, and differentiate by the positions of its vertices.

The pixel y of a view sees the mesh at depth z(y). Its neighbour shows this point at a grey value b(y), interpolated
bilinearly; a(y) is the grey value of the view. Around each pixel x, the normalised cross-correlation of the visible
pixels of a window compares a and b, and the energy is

    E = sum over x of w(x) (1 - NCC(x)),    w = trust x texture,

where ``trust`` rises from 0 at ``poor`` to 1 at ``good`` (occlusions, reflections and moving things have none) and
``texture`` is v / (v + ``texture``), v the smaller variance. Weights are constant in the derivative. Formulas:
docs/math.md, "Mesh refinement". The native version, ``kernels/cpu/refine.cpp``, is used if its library is passed.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field
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
from gs2d.meshing.raycast import NEAR, cast_camera, outlines

MIN_SCALE = 0.1  # depth in the neighbour / depth in the view; as in kernels/cpu/refine.cpp
OUTLINE = 2  # px on both sides of an outline that are ignored
ENOUGH = 0.5  # fraction of a window that must be visible in both images
DARK = 0.02  # grey value below which the brightness of two images is not compared


@dataclass(frozen=True)
class MatchSettings:
    """How two images are compared.

    Attributes
    ----------
    radius : int, px
        A window has 2 radius + 1 pixels a side.
    texture : float
        Variance of grey in [0, 1] that counts as noise.
    poor, good : float
        The trust in a window rises from 0 to 1 between these NCCs.
    occluded : float
        A point is visible in the neighbour if its depth there differs by less than this fraction.
    grazing : float
        Cosine between ray and face below which a pixel moves nothing.
    """

    radius: int = 2
    texture: float = 2e-4
    poor: float = 0.5
    good: float = 0.9
    occluded: float = 0.01
    grazing: float = 0.2


@dataclass(frozen=True, eq=False)
class GreyImage:
    """A photograph in grey.

    Attributes
    ----------
    camera : Camera
    grey : ndarray [H, W] float, in [0, 1]
    usable : ndarray [H, W] bool or None
        False for pixels to ignore.
    """

    camera: Camera
    grey: np.ndarray
    usable: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """A mesh in an image.

    Attributes
    ----------
    face : ndarray [H, W] int32
        The nearest face at each pixel centre; -1 without one.
    depth : ndarray [H, W] float, world units
        0 without a face.
    """

    face: np.ndarray
    depth: np.ndarray

    def inner(self, focal: float) -> np.ndarray:
        """Return the pixels [H, W] that show the surface away from outlines, where photographs mix two surfaces.

        Parameters
        ----------
        focal : float, px
        """
        edge = (self.depth <= 0) | outlines(self.depth, focal)
        return ~binary_dilation(edge, np.ones((3, 3), bool), iterations=OUTLINE)


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh whose vertices move along unit normals.

    Attributes
    ----------
    vertices : ndarray [P, 3] float64 world units
    faces : ndarray [F, 3] int32
    normals : ndarray [P, 3] float64
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True, eq=False)
class PixelPull:
    """Derivative and curvature of the energy by the depth of each pixel, and its sums.

    Attributes
    ----------
    gradient, curvature : ndarray [H, W] float
        By world units, and by their square.
    sums : ndarray [2] float64
        Of w (1 - NCC) and of w.
    """

    gradient: np.ndarray
    curvature: np.ndarray
    sums: np.ndarray = field(default_factory=lambda: np.zeros(2))

    @classmethod
    def zeros(cls, camera: Camera, dtype: np.dtype[Any] | type | str = np.float32) -> PixelPull:
        """Return zeros for the pixels of a camera."""
        return cls(*(np.zeros((camera.height, camera.width), dtype) for _ in range(2)))


@dataclass(frozen=True, eq=False)
class VertexPull:
    """Derivative and curvature of the energy by the distance of each vertex along its normal, [P] float64."""

    gradient: np.ndarray
    curvature: np.ndarray

    @classmethod
    def zeros(cls, count: int) -> VertexPull:
        """Return zeros for ``count`` vertices."""
        return cls(np.zeros(count), np.zeros(count))


def draw_mesh(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, *, near: float = NEAR, library: Library | None = None
) -> DrawnMesh:
    """Draw the depth of a mesh.

    Parameters
    ----------
    vertices : ndarray [P, 3] float64 world units
    faces : ndarray [F, 3] int32
    camera : Camera
    near : float, world units
        Nearer faces are left out.
    library : Library or None
        None: by ray casting, in numpy.
    """
    if library is not None:
        return DrawnMesh(*draw_on_cpu(library, vertices, faces, camera, near))
    hits = cast_camera(vertices, faces, camera, near=near)
    return DrawnMesh(hits.face, hits.depth)


def match_views(
    view: GreyImage,
    other: GreyImage,
    depth: np.ndarray,
    other_depth: np.ndarray,
    settings: MatchSettings,
    into: PixelPull,
    *,
    library: Library | None = None,
) -> None:
    """Compare a view with a neighbour and add the derivatives by the depth of its pixels to ``into``.

    Parameters
    ----------
    view, other : GreyImage
    depth, other_depth : ndarray [H, W], [h, w] world units
        Depth of the mesh in both; 0 without a surface.
    settings : MatchSettings
    into : PixelPull
    library : Library or None
        None: in numpy. The arrays have its precision.
    """
    if library is None:
        _match(view, other, depth, other_depth, settings, into)
    else:
        _match_natively((view, other), (depth, other_depth), settings, into, library)


def _match_natively(
    pair: tuple[GreyImage, GreyImage],
    depths: tuple[np.ndarray, np.ndarray],
    settings: MatchSettings,
    into: PixelPull,
    library: Library,
) -> np.ndarray:
    """Call the kernel; return its workspace [7, H, W], which begins with the warped neighbour."""
    (view, other), (depth, other_depth) = pair, depths
    motion = _motion(view, other)
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
    other: GreyImage,
    depth: np.ndarray,
    other_depth: np.ndarray,
    settings: MatchSettings,
    *,
    library: Library | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return which share of the difference between two images is brightness, and the weight of each pixel.

    Around each pixel, d is the difference of the mean grey values after one gain for the whole image, and v the sum of
    both variances. The share d^2 / (d^2 + v) is small on matt surfaces. Where it is large, brightness depends on the
    direction of view: a reflection, whose texture is not on the surface.

    Parameters
    ----------
    view, other, depth, other_depth, settings, library
        As of :func:`match_views`.

    Returns
    -------
    share, weight : ndarray [H, W] float64
        Where the images cannot be compared, NaN and 0. The weight is that of texture in :func:`match_views`.
    """
    if library is None:
        warped, _, visible = _warped(view, other, depth, other_depth, settings.occluded)
    else:
        into = PixelPull.zeros(view.camera, f"f{library.dtype.itemsize}")
        planes = _match_natively((view, other), (depth, other_depth), settings, into, library)
        warped, visible = planes[WARPED], planes[VISIBLE] > 0
    seen = visible.astype(np.float64)
    a, b = view.grey * seen, np.asarray(warped, np.float64)
    n, sum_a, sum_b, aa, bb = (_sums(k, settings.radius) for k in (seen, a, b, a * a, b * b))
    enough = visible & (n >= ENOUGH * (2 * settings.radius + 1) ** 2)
    n = np.maximum(n, 1.0)
    mean_a, mean_b = sum_a / n, sum_b / n
    lit = enough & (mean_a > DARK) & (mean_b > DARK)
    gain = float(np.exp(np.median(np.log(mean_a[lit] / mean_b[lit])))) if lit.any() else 1.0
    var_a = np.maximum(aa / n - mean_a**2, 0.0)
    var_b = np.maximum(bb / n - mean_b**2, 0.0) * gain**2
    weaker = np.minimum(var_a, var_b)
    weight = np.where(enough, weaker / (weaker + settings.texture), 0.0)
    brighter = (mean_a - gain * mean_b) ** 2
    share = brighter / np.maximum(brighter + var_a + var_b, 1e-12)
    return np.where(enough, share, np.nan), weight


def gather_vertices(
    surface: Surface,
    camera: Camera,
    face: np.ndarray,
    pull: PixelPull,
    into: VertexPull,
    settings: MatchSettings,
    library: Library | None = None,
) -> None:
    """Add the derivatives of the pixels of a view to the vertices of their faces.

    A vertex k that moves by s along its normal n_k moves the depth of a pixel of the face with normal m by
    share_k (m . n_k) / (m . ray) s.

    Parameters
    ----------
    surface : Surface
    camera : Camera
    face : ndarray [H, W] int32
        Of :class:`DrawnMesh`.
    pull : PixelPull
    into : VertexPull
    settings : MatchSettings
    library : Library or None
        None: in numpy.
    """
    local = np.ascontiguousarray(surface.vertices @ camera.rotation.T + camera.T_cam_world[:3, 3])
    normals = np.ascontiguousarray(surface.normals @ camera.rotation.T)
    if library is None:
        _gather(Surface(local, surface.faces, normals), camera, face, pull, into, settings.grazing)
        return
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


# -- in numpy ----------------------------------------------------------------------------------------------------------
def _rays(camera: Camera) -> np.ndarray:
    """Return the rays of pixel centres, [H, W, 3] with z = 1."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=2)


def _motion(view: GreyImage, other: GreyImage) -> np.ndarray:
    """Return the transform [4, 4] from the view's camera axes to the neighbour's."""
    return np.asarray(other.camera.T_cam_world @ np.linalg.inv(view.camera.T_cam_world))


def _warped(
    view: GreyImage, other: GreyImage, depth: np.ndarray, other_depth: np.ndarray, occluded: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the neighbour as the view sees it [H, W], its derivative by depth [H, W], and what is visible [H, W]."""
    motion = _motion(view, other)
    turned = _rays(view.camera) @ motion[:3, :3].T
    d = np.asarray(depth, np.float64)
    point = d[..., None] * turned + motion[:3, 3]
    seen = (d > 0) & (point[..., 2] > MIN_SCALE * d)
    if view.usable is not None:
        seen &= view.usable
    z = np.where(seen, point[..., 2], 1.0)
    u, v = point[..., 0] / z, point[..., 1] / z
    camera = other.camera
    x, y = camera.fx * u + camera.cx - 0.5, camera.fy * v + camera.cy - 0.5
    seen &= (x >= 0) & (y >= 0) & (x < camera.width - 1) & (y < camera.height - 1)
    x, y = np.where(seen, x, 0.0), np.where(seen, y, 0.0)
    i, j = x.astype(np.int64), y.astype(np.int64)
    if other.usable is not None:
        seen &= other.usable[j + (y - j >= 0.5), i + (x - i >= 0.5)]
    around = np.stack([other_depth[j + dj, i + di] for dj in (0, 1) for di in (0, 1)])
    seen &= ((around > 0) & (np.abs(around - z) <= occluded * z)).any(axis=0)
    p00, p01, p10, p11 = (other.grey[j + dj, i + di] for dj in (0, 1) for di in (0, 1))
    fx, fy = x - i, y - j
    by_x, by_y = (p01 - p00) * (1 - fy) + (p11 - p10) * fy, (p10 - p00) * (1 - fx) + (p11 - p01) * fx
    value = p00 + fx * (p01 - p00) + fy * by_y
    slope = by_x * camera.fx * (turned[..., 0] - u * turned[..., 2])
    slope += by_y * camera.fy * (turned[..., 1] - v * turned[..., 2])
    return np.where(seen, value, 0.0), np.where(seen, slope / z, 0.0), seen


def _sums(values: np.ndarray, radius: int) -> np.ndarray:
    """Return the sums over windows, with zeros beyond the border."""
    side = 2 * radius + 1
    return np.asarray(uniform_filter(values, side, np.float64, mode="constant") * side**2)


def _match(
    view: GreyImage,
    other: GreyImage,
    depth: np.ndarray,
    other_depth: np.ndarray,
    settings: MatchSettings,
    into: PixelPull,
) -> None:
    b, slope, seen = _warped(view, other, depth, other_depth, settings.occluded)
    visible = seen.astype(np.float64)
    a = np.asarray(view.grey, np.float64) * visible
    n, sum_a, sum_b, aa, bb, ab = (_sums(k, settings.radius) for k in (visible, a, b, a * a, b * b, a * b))
    enough = seen & (n >= ENOUGH * (2 * settings.radius + 1) ** 2)
    n = np.maximum(n, 1.0)
    mean_a, mean_b = sum_a / n, sum_b / n
    var_a, var_b = np.maximum(aa / n - mean_a**2, 0.0), np.maximum(bb / n - mean_b**2, 0.0)
    product = np.sqrt(var_a * var_b)
    enough &= product > 0
    ncc = np.where(enough, ab / n - mean_a * mean_b, 0.0) / np.where(enough, product, 1.0)
    weaker = np.minimum(var_a, var_b)
    weight = np.clip((ncc - settings.poor) / (settings.good - settings.poor), 0.0, 1.0)
    weight = np.where(enough, weight * weaker / (weaker + settings.texture), 0.0)
    by_grey = weight / (n * np.where(enough, product, 1.0))
    by_warped = weight / (n * np.where(enough, var_b, 1.0))
    factors = (-by_grey, ncc * by_warped, by_grey * mean_a - ncc * by_warped * mean_b, by_warped)
    of_a, of_b, of_one, bend = (_sums(k, settings.radius) for k in factors)
    into.gradient[...] += np.where(seen, (of_a * a + of_b * b + of_one) * slope, 0.0)
    into.curvature[...] += np.where(seen, bend * slope**2, 0.0)
    into.sums[...] += (weight * (1 - ncc)).sum(), weight.sum()


def _gather(
    surface: Surface, camera: Camera, face: np.ndarray, pull: PixelPull, into: VertexPull, grazing: float
) -> None:
    """Gather with a surface in camera axes."""
    rows, columns = np.nonzero((face >= 0) & ((pull.gradient != 0) | (pull.curvature != 0)))
    corners = surface.faces[face[rows, columns]]  # [n, 3]
    ray = _rays(camera)[rows, columns]
    p = surface.vertices[corners]  # [n, 3, 3]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    along = (normal * ray).sum(axis=1)
    front = (along < 0) & (along**2 > grazing**2 * (normal**2).sum(axis=1) * (ray**2).sum(axis=1))
    corners, along, ray, p = corners[front], along[front], ray[front], p[front]
    share = np.stack([(np.cross(p[:, (k + 1) % 3], p[:, (k + 2) % 3]) * ray).sum(axis=1) for k in range(3)], axis=1)
    share /= share.sum(axis=1, keepdims=True)
    by = np.einsum("nkc,nc->nk", surface.normals[corners], normal[front]) / along[:, None]
    gradient, curvature = (values[rows, columns][front, None] for values in (pull.gradient, pull.curvature))
    np.add.at(into.gradient, corners, share * by * gradient)
    np.add.at(into.curvature, corners, share * by**2 * curvature)
