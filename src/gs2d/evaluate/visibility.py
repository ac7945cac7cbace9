"""What cameras can see of a triangle mesh: depth buffers, and in how many views a point is visible."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.ndimage import maximum_filter

from gs2d.camera import Camera
from gs2d.triangles import Mesh

_PAIRS = 1 << 21  # pairs of face and pixel at a time


def depth_buffer(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Depth [H, W] wu along the optical axis of the nearest face at every pixel centre; infinity where there is none.

    Both sides of a face count. For camera-frame corners a, b, c and a ray r = (x, y, 1), the values r.(b x c),
    r.(c x a), r.(a x b) are barycentric coordinates up to scale (Olano and Greer 1997), which needs no clipping at the
    camera plane; the two faces at an edge compute exactly opposite numbers for it, so no ray slips between them.
    """
    buffer = np.full(camera.height * camera.width, np.inf)
    corners = mesh.vertices.astype(np.float64) @ camera.rotation.T + camera.T_cam_world[:3, 3]
    faces, low, size = _pixel_boxes(corners, mesh.faces, camera)
    counts = size.prod(axis=1)
    ends = np.cumsum(counts)
    start = 0
    while start < len(faces):
        stop = max(start + 1, int(np.searchsorted(ends, (ends[start - 1] if start else 0) + _PAIRS)))
        part = slice(start, stop)
        _draw(buffer, corners[mesh.faces[faces[part]]], low[part], size[part], camera)
        start = stop
    return buffer.reshape(camera.height, camera.width)


def _pixel_boxes(corners: np.ndarray, faces: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces [n] that may cover a pixel centre, the first (column, row) [n, 2] of their boxes and the sizes [n, 2]."""
    z = corners[:, 2]
    ahead = z > 1e-9
    safe = np.where(ahead, z, 1.0)
    # pixel centres are the integers of these coordinates
    x = corners[:, 0] / safe * camera.fx + (camera.cx - 0.5)
    y = corners[:, 1] / safe * camera.fy + (camera.cy - 0.5)
    whole = np.arange(len(faces))
    if ahead.all():
        crossing = np.zeros(0, np.int64)
    else:
        count = ahead[faces].sum(axis=1)
        crossing, whole = np.flatnonzero((count > 0) & (count < 3)), np.flatnonzero(count == 3)
    # most faces of a fine mesh lie between two columns or two rows of pixel centres: drop them on integers, cheaply
    for values, end in ((x, camera.width), (y, camera.height)):
        cell = np.floor(np.clip(values, -1, end)).astype(np.int32)
        c0, c1, c2 = (cell[faces[whole, i]] for i in range(3))
        whole = whole[(c0 != c1) | (c1 != c2)]
    low = np.zeros((len(whole) + len(crossing), 2), np.int64)  # faces that cross the camera plane: the whole image
    high = np.tile(np.array([camera.width - 1, camera.height - 1]), (len(low), 1))
    for axis, (values, end) in enumerate(((x, camera.width), (y, camera.height))):
        ends = values[faces[whole]]
        low[: len(whole), axis] = np.clip(np.ceil(ends.min(axis=1) - 1e-6), 0, end)
        high[: len(whole), axis] = np.clip(np.floor(ends.max(axis=1) + 1e-6), -1, end - 1)
    hit = (high >= low).all(axis=1)
    return np.concatenate([whole, crossing])[hit], low[hit], (high - low + 1)[hit]


def _draw(buffer: np.ndarray, corners: np.ndarray, low: np.ndarray, size: np.ndarray, camera: Camera) -> None:
    """Draw faces with camera-frame corners [n, 3, 3] over their boxes into the buffer."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    edges = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)  # [n, 3, 3]
    determinant = np.einsum("ni,ni->n", a, edges[:, 0])
    counts = size.prod(axis=1)
    face = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    column = low[face, 0] + within % size[face, 0]
    row = low[face, 1] + within // size[face, 0]
    x = (column + 0.5 - camera.cx) / camera.fx
    y = (row + 0.5 - camera.cy) / camera.fy
    e = edges[face]
    weights = [e[:, i, 0] * x + e[:, i, 1] * y + e[:, i, 2] for i in range(3)]
    total = weights[0] + weights[1] + weights[2]
    inside = ((weights[0] >= 0) & (weights[1] >= 0) & (weights[2] >= 0)) | (
        (weights[0] <= 0) & (weights[1] <= 0) & (weights[2] <= 0)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        z = determinant[face] / total  # r z lies in the plane of the face
    good = inside & (total != 0) & (z > 0)
    np.minimum.at(buffer, (row * camera.width + column)[good], z[good])


def visible_counts(
    points: np.ndarray,
    mesh: Mesh,
    cameras: Sequence[Camera],
    *,
    tolerance: float,
    max_side: int = 800,
    workers: int | None = None,
) -> np.ndarray:
    """In how many views each point [P, 3] is visible, the mesh being the only thing that hides it.

    A point is visible where it lies in the image and no deeper than ``tolerance`` wu behind the deepest of the 3x3
    pixels around it: the neighbours spare surfaces seen at a slant, whose depth changes within a pixel.

    Parameters
    ----------
    max_side : int
        Images are drawn at most this large, px.

    Returns
    -------
    ndarray [P] int64
    """

    def visible(camera: Camera) -> np.ndarray:
        small = _shrunk(camera, max_side)
        buffer = maximum_filter(depth_buffer(mesh, small), size=3, mode="nearest")
        index, rows, columns, z = _in_image(points, small)
        return np.asarray(index[z <= buffer[rows, columns] + tolerance])

    counts = np.zeros(len(points), dtype=np.int64)
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        for index in pool.map(visible, cameras):
            counts[index] += 1
    return counts


def frustum_counts(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """In how many images each point [P, 3] lies, whatever is before it."""
    counts = np.zeros(len(points), dtype=np.int64)
    for camera in cameras:
        counts[_in_image(points, camera)[0]] += 1
    return counts


def _in_image(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Index, row, column and depth of the points in the image."""
    pixels, z = camera.project(points)
    inside = (z > 0) & (pixels >= 0).all(axis=1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    index = np.flatnonzero(inside)
    return index, pixels[index, 1].astype(np.int64), pixels[index, 0].astype(np.int64), z[index]


def _shrunk(camera: Camera, max_side: int) -> Camera:
    factor = max(camera.width, camera.height) / max_side
    if factor <= 1:
        return camera
    return camera.resized(max(1, round(camera.width / factor)), max(1, round(camera.height / factor)))
