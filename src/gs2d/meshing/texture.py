"""Bake a texture: each texel is a weighted mean of the few images with the best view of its surface point.

First, all images are compared (``agreement``): each is corrected to the consensus colours, and its scores decrease
where it shows something else, such as an obstacle.

An image with focal lengths f_x, f_y that sees the point at depth z, along the ray r, on a surface with unit normal n,
has q = f_x f_y |n . r| / z^3 pixels per unit of surface (the Jacobian of the projection), which combines cosine and
resolution. Its score is s = q b a, where b decreases from 1 to 0.01 over the last ``FEATHER`` pixels before an outline,
the image border or a mask, and a decreases to 0.001 where the image disagrees with the others. The highest ``best`` + 1
scores of a texel are kept, and its colour is

    sum_v w_v c_v / sum_v w_v,    w_v = s_v - (the lowest of them)

so the weights of ``best`` images are continuous across the surface: where one image replaces another, both have weight
0. See docs/math.md and docs/notebook/meshing.md.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array

from gs2d.core import extras
from gs2d.core.camera import Camera
from gs2d.core.image_arrays import area_downscale, mask_downscale
from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.errors import ProtocolError
from gs2d.meshing.agreement import VOTE, agree, corrected
from gs2d.meshing.evidence import areas
from gs2d.meshing.raycast import cast_camera, outlines
from gs2d.meshing.simplify import simplify

# -- charts and texels -------------------------------------------------------------------------------------------------
PADDING = 4  # texels between charts: two mipmap levels do not mix them
_BAND = 1 << 20  # texels per chunk


@dataclass(frozen=True, eq=False)
class Atlas:
    """A mesh whose vertices are split along the seams of a texture."""

    mesh: Mesh  # before the split
    source: np.ndarray  # [Q] int64: vertex of ``mesh`` of each split vertex
    faces: np.ndarray  # [F, 3] int32 indices of split vertices; face f is face f of ``mesh``
    uv: np.ndarray  # [Q, 2] float32 texture coordinates in [0, 1], from the upper left corner
    charts: int


@dataclass(frozen=True, eq=False)
class Texels:
    """The T texels of a texture that lie on the mesh, row by row."""

    size: int  # texels in a row
    index: np.ndarray  # [T] int32: row * size + column
    face: np.ndarray  # [T] int32
    weights: np.ndarray  # [T, 2] float32: barycentric coordinates of the texel's centre for two corners of its face

    def interpolated(self, values: np.ndarray, faces: np.ndarray, part: slice = slice(None)) -> np.ndarray:
        """Interpolate vertex values [P, C] at the texels of ``part``, float32 [t, C]."""
        corners = faces[self.face[part]]
        w = self.weights[part]
        values = values.astype(np.float32, copy=False)
        result = values[corners[:, 2]]
        for k in range(2):
            result += w[:, k, None] * (values[corners[:, k]] - values[corners[:, 2]])
        return np.asarray(result)


def required(module: str) -> Any:
    """Import a package of the extra ``texture``, or raise BackendError."""
    return extras.required("texture", module, "--texture", "leave --texture out")


def simplified(mesh: Mesh, faces: int) -> Mesh:
    """Simplify to at most ``faces`` triangles by quadric edge collapse; a simplified mesh has no vertex colours."""
    return mesh if len(mesh.faces) <= faces else simplify(Mesh(mesh.vertices, mesh.faces), faces=faces)


def unwrap(mesh: Mesh, size: int) -> Atlas:
    """Split a mesh into charts and pack them into the unit square, ``PADDING`` texels apart at this ``size``.

    Raises BackendError if the package xatlas is missing, ProtocolError if the mesh has no faces.
    """
    xatlas = required("xatlas")
    if not len(mesh.faces):
        raise ProtocolError("a texture needs a mesh with faces, got an empty mesh; extract it with other limits")
    atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bilinear = size, PADDING, True
    vertices = mesh.vertices.astype(np.float64)
    vertices = (vertices - vertices.mean(axis=0)) / (float(np.ptp(vertices, axis=0).max()) or 1.0)
    atlas.add_mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(mesh.faces, np.uint32))
    atlas.generate(xatlas.ChartOptions(), pack, False)
    source, faces, uv = atlas[0]
    uv = np.nan_to_num(uv.astype(np.float32))  # faces without area have no coordinates
    return Atlas(mesh, source.astype(np.int64), faces.astype(np.int32), uv, int(atlas.chart_count))


def texels_of(atlas: Atlas, size: int) -> Texels:
    """Return the texels whose centres are in a chart.

    The charts are rasterized by the ray caster, as a mesh on the plane z = 1 of a camera with f = 1.
    """
    rows = max(1, _BAND // size)
    flat = np.concatenate([atlas.uv.astype(np.float64) * size, np.ones((len(atlas.uv), 1))], axis=1)
    index, face, weights = [], [], []
    for row in range(0, size, rows):
        camera = Camera(size, min(rows, size - row), 1.0, 1.0, 0.0, float(-row), np.eye(4))
        hits = cast_camera(flat, atlas.faces, camera)
        hit = np.flatnonzero(hits.face.reshape(-1) >= 0)
        index.append((hit + row * size).astype(np.int32))
        face.append(hits.face.reshape(-1)[hit])
        weights.append(hits.weights.reshape(-1, 3)[hit, :2])
    return Texels(size, np.concatenate(index), np.concatenate(face), np.concatenate(weights))


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Return unit vertex normals [P, 3] float32, weighted by face area; (0, 0, 1) if the area is 0."""
    vertices = mesh.vertices.astype(np.float64)
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    summed = np.zeros_like(vertices)
    for axis in range(3):
        for k in range(3):
            summed[:, axis] += np.bincount(mesh.faces[:, k], areas[:, axis], len(vertices))
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.where(length > 0, summed / np.where(length > 0, length, 1.0), (0.0, 0.0, 1.0)).astype(np.float32)


# -- colours -----------------------------------------------------------------------------------------------------------
BEST = 4  # images in the mean
FEATHER = 4.0  # px
MIN_FEATHER = 0.01
GRAZING = 0.1  # cosine below which a surface is not visible
MAX_SIDE = 1600  # px; of the depth maps for occlusion
MIN_SIZE, MAX_SIZE, MAX_AUTO_SIZE = 64, 8192, 4096
_CHUNK = 1 << 17  # texels
_TYPICAL_USE = 0.55  # fraction of the atlas that charts cover
_FINER = 2.0  # texels per pixel length; keeps edges sharp after resampling twice
_SAMPLES = 5000  # faces that determine the texture size
COARSE = 2  # images are downscaled by this factor for the comparison
_STRIDE = 4  # texels between points of the comparison
TABLE_BYTES = 512 << 20  # limit for the colours of these points in all images


@dataclass(frozen=True, eq=False)
class ColorSource:
    """An image to take colours from."""

    camera: Camera
    image: np.ndarray  # [H, W, 3 or 4] uint8, straight alpha; pixels with alpha below one half are ignored
    valid: np.ndarray | None = None  # [H, W] bool, False for pixels to ignore

    def shrunk(self, factor: int) -> ColorSource:
        """Downscale by averaging ``factor`` x ``factor`` pixels."""
        factor = min(factor, *self.image.shape[:2])
        valid = None if self.valid is None else mask_downscale(self.valid, factor, need=1.0)
        return ColorSource(self.camera.downscaled(factor), area_downscale(self.image, factor), valid)


ColorSources = Callable[[int], Iterable[ColorSource]]
"""Reads all images one at a time, in a fixed order, downscaled by the factor that is its argument."""


@dataclass(frozen=True, eq=False)
class Baked:
    """A textured mesh, and how many of its texels no image sees."""

    mesh: TexturedMesh
    texels: int  # on the surface
    unseen: int  # of them filled from their neighbours
    charts: int


def texture_size(mesh: Mesh, cameras: list[Camera]) -> int:
    """Return the side, a power of two, of a texture with at least two texels per pixel length of the best views.

    Determined from a sample of the faces and the camera with the highest resolution for each, without occlusion.
    """
    vertices = mesh.vertices.astype(np.float64)
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    some = np.linspace(0, len(area) - 1, min(len(area), _SAMPLES)).astype(np.int64)
    normals = np.cross(b - a, c - a)[some] / np.maximum(2 * area[some, None], 1e-30)
    density = np.zeros(len(some))
    for camera in cameras:
        ray = (a + b + c)[some] / 3 - camera.center
        z = ray @ camera.forward
        facing = -(ray * normals).sum(axis=1)
        ahead = z > 0
        q = camera.fx * camera.fy * facing[ahead] / z[ahead] ** 3
        density[ahead] = np.maximum(density[ahead], q)
    ranked = np.argsort(density)
    fraction = np.cumsum(area[some][ranked])
    median = density[ranked[min(np.searchsorted(fraction, fraction[-1] / 2), len(ranked) - 1)]]
    side = _FINER * np.sqrt(max(float(area.sum() * median) / _TYPICAL_USE, 1.0))
    return int(np.clip(2 ** np.ceil(np.log2(side)), 4 * MIN_SIZE, MAX_AUTO_SIZE))


def bake(atlas: Atlas, images: ColorSources, size: int, *, best: int = BEST, threads: int | None = None) -> Baked:
    """Colour the texels of an atlas from images, which are read twice; ProtocolError if none sees the surface.

    ``size`` is the side of the texture, which needs about 70 bytes of memory per texel on the surface; ``best`` is the
    number of images that contribute to a texel.
    """
    texels = texels_of(atlas, size)
    colors, visible = surface_colors(atlas.mesh, texels, images, best=best, threads=threads)
    fill_unseen(atlas, texels, colors, visible)
    mesh = TexturedMesh(
        vertices=atlas.mesh.vertices[atlas.source],
        normals=vertex_normals(atlas.mesh)[atlas.source],
        faces=atlas.faces,
        uv=atlas.uv,
        texture=spread(texels, colors),
    )
    return Baked(mesh, len(visible), int(len(visible) - visible.sum()), atlas.charts)


def surface_colors(
    mesh: Mesh, texels: Texels, images: ColorSources, *, best: int = BEST, threads: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return colours [T, 3] uint8 of points on the faces of a mesh, and which points any image sees [T].

    Parameters and errors are those of ``bake``.
    """
    origin = mesh.vertices.astype(np.float64).mean(axis=0)
    points = _Points.of(mesh, texels, origin)
    coarse = (_ImageLookup(mesh, image, origin) for image in images(COARSE))
    common, samples = _comparison_points(points, texels, float(areas(mesh).sum()), coarse)
    consensus, gains = agree(samples)
    chooser = _Chooser(points, best, threads or os.cpu_count() or 1)
    for number, image in enumerate(images(1)):
        lookup = _ImageLookup(mesh, image, origin)
        rows = np.flatnonzero(samples[number][:, 3])
        lookup.correct(common.positions[rows], samples[number][rows], consensus[rows], gains[number])
        chooser.add(lookup)
    colors, visible = chooser.colors()
    if not visible.any():
        raise ProtocolError(f"none of {len(samples)} photographs sees the mesh; does it belong to this capture?")
    return colors, visible


@dataclass(frozen=True, eq=False)
class _Points:
    """Surface points relative to an origin, float32: positions x [n, 3], normals n [n, 3] and n . x [n]."""

    positions: np.ndarray
    normals: np.ndarray
    heights: np.ndarray

    @classmethod
    def of(cls, mesh: Mesh, texels: Texels, origin: np.ndarray) -> _Points:
        """Return the points of texels."""
        vertices, vertex_normal = mesh.vertices - origin, vertex_normals(mesh)
        n = len(texels.index)
        positions, normals = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
        for start in range(0, n, _CHUNK):
            part = slice(start, start + _CHUNK)
            positions[part] = texels.interpolated(vertices, mesh.faces, part)
            normal = texels.interpolated(vertex_normal, mesh.faces, part)
            normals[part] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return cls(positions, normals, (positions * normals).sum(axis=1))

    def subset(self, rows: np.ndarray | slice) -> _Points:
        """Return some of the points."""
        return _Points(self.positions[rows], self.normals[rows], self.heights[rows])


def _comparison_points(
    points: _Points, texels: Texels, area: float, images: Iterable[_ImageLookup]
) -> tuple[_Points, list[np.ndarray]]:
    """Return points of the comparison, and their colours and votes in each image, [P, 4] uint8.

    ``area`` is that of the mesh, world units^2. Every second point is dropped if the table becomes too large.
    """
    row, column = np.divmod(texels.index, texels.size)
    points = points.subset(np.flatnonzero((row % _STRIDE == 0) & (column % _STRIDE == 0)))
    area /= max(len(points.positions), 1)  # of a point
    table: list[np.ndarray] = []
    for image in images:
        while (len(table) + 1) * len(points.positions) * 4 > TABLE_BYTES:
            points = points.subset(slice(None, None, 2))
            table = [samples[::2].copy() for samples in table]
        samples = np.zeros((len(points.positions), 4), np.uint8)
        rows, density, clear, cosine, colors = image.visible_points(points, np.zeros(len(samples), np.float32))
        resolved = np.minimum(density * area, 1)  # pixels per point
        samples[rows, :3] = np.rint(colors)
        samples[rows, 3] = np.ceil(VOTE * clear * cosine * resolved)
        table.append(samples)
    return points, table


class _Chooser:
    """The best images of each texel so far."""

    def __init__(self, points: _Points, best: int, threads: int) -> None:
        self._points, self._threads = points, threads
        n = len(points.positions)
        self._parts = [slice(start, min(start + _CHUNK, n)) for start in range(0, n, _CHUNK)]
        self._scores = np.zeros((n, best + 1), np.float32)
        self._least = np.zeros(n, np.float32)  # lowest score of each texel
        self._colors = np.zeros((n, best + 1, 3), np.uint8)

    def add(self, lookup: _ImageLookup) -> None:
        """Replace the lowest score of every texel for which this image is better."""
        with ThreadPoolExecutor(self._threads) as pool:
            for _ in pool.map(lambda part: self._choose(lookup, part), self._parts):
                pass

    def _choose(self, lookup: _ImageLookup, part: slice) -> None:
        scores, least = self._scores[part], self._least[part]
        rows, density, clear, _, colors = lookup.visible_points(self._points.subset(part), least)
        worst = scores[rows].argmin(axis=1)
        scores[rows, worst], self._colors[part][rows, worst] = density * clear, np.rint(colors)
        least[rows] = scores[rows].min(axis=1)

    def colors(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean colours [T, 3] uint8 of the texels, and which of them any image sees [T]."""
        colors = np.zeros((len(self._scores), 3), np.uint8)
        for part in self._parts:
            weights = self._scores[part] - 0.999 * self._least[part][:, None]  # 0.999: equal scores must not give 0
            total = np.maximum(weights.sum(axis=1), 1e-30)
            mean = np.einsum("tk,tkc->tc", weights, self._colors[part].astype(np.float32)) / total[:, None]
            colors[part] = np.rint(mean)
        return colors, self._scores.max(axis=1) > 0


class _ImageLookup:
    """An image with its depth map of the mesh, and the distances of its pixels from outlines."""

    def __init__(self, mesh: Mesh, image: ColorSource, origin: np.ndarray) -> None:
        camera = image.camera
        shrink = max(camera.width, camera.height) / MAX_SIDE
        small = camera
        if shrink > 1:
            small = camera.resized(max(1, round(camera.width / shrink)), max(1, round(camera.height / shrink)))
        self._camera, self._small, self._image = camera, small, image.image
        self._rotation = camera.rotation.astype(np.float32)
        self._shift = (camera.T_cam_world[:3, 3] + camera.rotation @ origin).astype(np.float32)
        self._center = (camera.center - origin).astype(np.float32)
        self._depth = cast_camera(mesh.vertices.astype(np.float64), mesh.faces, small).depth
        self._clear = feather(self._depth, small.fx, _shown(image, small))

    def correct(self, positions: np.ndarray, samples: np.ndarray, colors: np.ndarray, gain: np.ndarray) -> None:
        """Correct the image to the consensus colours, and lower its score where it disagrees."""
        pixels = np.stack(self._project(positions)[:2], axis=1)
        self._image, weights = corrected(self._image, pixels, samples, colors, gain, COARSE)
        height, width = self._clear.shape
        row = ((np.arange(height) + 0.5) * (weights.shape[0] / height)).astype(np.int64)[:, None]
        column = ((np.arange(width) + 0.5) * (weights.shape[1] / width)).astype(np.int64)[None]
        self._clear *= weights[row, column]

    def visible_points(self, points: _Points, least: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the visible points with a score above ``least`` [n].

        Returns their rows [m] int64, pixels per unit of surface (q) [m], factors for the distance from an outline (b)
        [m], cosines [m] and colours [m, 3].
        """
        facing = points.normals @ self._center - points.heights
        z = points.positions @ self._rotation[2] + self._shift[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            density = np.float32(self._camera.fx * self._camera.fy) * facing / (z * z * z)
        rows = np.flatnonzero((facing > 0) & (z > 0) & (density > least))  # a cheap test for all points
        camera, small = self._camera, self._small
        x, y, z = self._project(points.positions[rows])
        inside = (x >= 0.5) & (y >= 0.5) & (x <= camera.width - 0.5) & (y <= camera.height - 0.5)
        rows, x, y, z = rows[inside], x[inside], y[inside], z[inside]
        column = np.minimum((x * (small.width / camera.width)).astype(np.int32), small.width - 1)
        row = np.minimum((y * (small.height / camera.height)).astype(np.int32), small.height - 1)
        pixel = row * small.width + column
        clear = self._clear.reshape(-1)[pixel]
        better = density[rows] * clear > least[rows]
        rows, x, y, z, pixel, clear = (values[better] for values in (rows, x, y, z, pixel, clear))
        ray = points.positions[rows] - self._center
        cosine = facing[rows] / np.sqrt((ray * ray).sum(axis=1))
        # On a plane, depth changes by tan(incidence) footprints per pixel; the tolerance is twice that plus one.
        tolerance = z / small.fx * (1 + 2 / np.maximum(cosine, GRAZING))
        visible = (cosine > GRAZING) & (np.abs(z - self._depth.reshape(-1)[pixel]) <= tolerance)
        rows = rows[visible]
        return rows, density[rows], clear[visible], cosine[visible], bilinear(self._image, x[visible], y[visible])

    def _project(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return x and y in px, and the depth."""
        x, y, z = (positions @ self._rotation[i] + self._shift[i] for i in range(3))
        return self._camera.fx * x / z + self._camera.cx, self._camera.fy * y / z + self._camera.cy, z


def _shown(source: ColorSource, small: Camera) -> np.ndarray:
    """Return which pixels [H, W] of the downscaled camera may be used."""
    image, valid = source.image, source.valid
    height, width = image.shape[:2]
    shown = np.ones((height, width), bool) if valid is None else valid
    if image.shape[2] == 4:
        shown = shown & (image[..., 3] >= 128)
    row = ((np.arange(small.height) + 0.5) * height / small.height).astype(np.int64)[:, None]
    column = ((np.arange(small.width) + 0.5) * width / small.width).astype(np.int64)[None]
    return np.asarray(shown[row, column])


def feather(depth: np.ndarray, focal: float, shown: np.ndarray) -> np.ndarray:
    """Return the feather factor of pixels, float32 [H, W]; 0 for unusable pixels.

    It is 1 at ``FEATHER`` pixels or more from outlines, the image border and pixels that are not ``shown``, and falls
    to ``MIN_FEATHER`` beside them.
    """
    usable = (depth > 0) & shown
    clear = np.pad(usable & ~outlines(depth, focal), 1)  # pixels beyond the border are unknown
    distance = distance_transform_edt(clear)[1:-1, 1:-1]
    return np.where(usable, np.clip(distance / FEATHER, MIN_FEATHER, 1), 0).astype(np.float32)


def bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Sample an image [H, W, >= 3] bilinearly at positions in px (pixel centres at +0.5), clamped; float32 [m, 3]."""
    height, width = image.shape[:2]
    flat = image.reshape(height * width, -1)
    x, y = np.clip(x - 0.5, 0, width - 1), np.clip(y - 0.5, 0, height - 1)
    column, row = np.minimum(x.astype(np.int64), max(width - 2, 0)), np.minimum(y.astype(np.int64), max(height - 2, 0))
    right, below = int(width > 1), width * int(height > 1)
    corner = row * width + column
    fx, fy = (x - column).astype(np.float32)[:, None], (y - row).astype(np.float32)[:, None]
    upper = flat[corner, :3] * (1 - fx) + flat[corner + right, :3] * fx
    lower = flat[corner + below, :3] * (1 - fx) + flat[corner + below + right, :3] * fx
    return np.asarray(upper * (1 - fy) + lower * fy)


def fill_unseen(atlas: Atlas, texels: Texels, colors: np.ndarray, visible: np.ndarray) -> None:
    """Colour the texels that no image sees, in place, from adjacent surface, across charts.

    Vertices get the mean of the visible texels around them. Other vertices get the mean of their coloured neighbours,
    ring by ring, or the mean of all colours if their component has none. Texels interpolate the vertices of their face.
    """
    if visible.all():
        return
    faces, count = atlas.mesh.faces, len(atlas.mesh.vertices)
    face, w = texels.face[visible], texels.weights[visible].astype(np.float64)
    weights = [w[:, 0], w[:, 1], 1 - w[:, 0] - w[:, 1]]
    total, valid = np.zeros((count, 3)), np.zeros(count)
    for k, weight in enumerate(weights):
        valid += np.bincount(faces[face, k], weight, count)
        for channel in range(3):
            total[:, channel] += np.bincount(faces[face, k], weight * colors[visible, channel], count)
    done = valid > 1e-6
    values = np.where(done[:, None], total / np.maximum(valid, 1e-6)[:, None], 0)
    ends = faces.reshape(-1), np.roll(faces, 1, axis=1).reshape(-1)
    half = coo_array((np.ones(faces.size), ends), shape=(count, count)).tocsr()
    edges = half + half.T
    while True:
        degree = edges @ done
        ring = ~done & (degree > 0)
        if not ring.any():
            break
        values[ring] = (edges @ np.where(done[:, None], values, 0))[ring] / degree[ring, None]
        done |= ring
    values[~done] = colors[visible].mean(axis=0)
    rows = np.flatnonzero(~visible)
    hidden = Texels(texels.size, texels.index[rows], texels.face[rows], texels.weights[rows])
    colors[rows] = np.rint(np.clip(hidden.interpolated(values, faces), 0, 255))


def spread(texels: Texels, colors: np.ndarray) -> np.ndarray:
    """Return the texture [S, S, 3] uint8. Texels outside all charts get the colour of the nearest texel in a chart.

    Filtering at chart borders and mipmaps then do not mix in a background colour.
    """
    size = texels.size
    texture, empty = np.zeros((size * size, 3), np.uint8), np.ones(size * size, bool)
    texture[texels.index], empty[texels.index] = colors, False
    nearest = distance_transform_edt(empty.reshape(size, size), return_distances=False, return_indices=True)
    return np.asarray(texture.reshape(size, size, 3)[nearest[0], nearest[1]])
