"""What cameras can see of a triangle mesh: depth buffers, and in how many views a point is visible."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.evaluation.nearest import on_gpu, tensor_on

_PAIRS = 1 << 21  # pairs of face and pixel at a time


def depth_buffer(mesh: Mesh, camera: Camera, *, device: str = "cpu") -> np.ndarray:
    """Depth [H, W] wu along the optical axis of the nearest face at every pixel centre; infinity where there is none.

    Both sides of a face count. For camera-frame corners a, b, c and a ray r = (x, y, 1), the values r.(b x c),
    r.(c x a), r.(a x b) are barycentric coordinates up to scale (Olano and Greer 1997), which needs no clipping at the
    camera plane; the two faces at an edge compute exactly opposite numbers for it, so no ray slips between them.
    """
    return np.asarray(_depths(*_tensors(mesh, device), camera).cpu().numpy())


def _tensors(mesh: Mesh, device: str) -> tuple[Tensor, Tensor]:
    """Vertices [P, 3] float64 and faces [F, 3] int64 on a device."""
    return tensor_on(device, mesh.vertices), tensor_on(device, mesh.faces, np.int64)


def _in_camera(points: Tensor, camera: Camera) -> Tensor:
    """Points [P, 3] in the camera's frame."""
    T = tensor_on(points.device, camera.T_cam_world)
    return points @ T[:3, :3].T + T[:3, 3]


def _depths(vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
    """:func:`depth_buffer` of vertices [P, 3] float64 and faces [F, 3]."""
    buffer = vertices.new_full((camera.height * camera.width,), math.inf)
    corners = _in_camera(vertices, camera)
    faces, low, size = _pixel_boxes(corners, faces, camera)
    ends = size.prod(dim=1).cumsum(0).cpu().numpy()
    start = 0
    while start < len(faces):
        stop = max(start + 1, int(np.searchsorted(ends, (ends[start - 1] if start else 0) + _PAIRS)))
        part = slice(start, stop)
        _draw(buffer, corners[faces[part]], low[part], size[part], camera)
        start = stop
    return buffer.view(camera.height, camera.width)


def _pixel_boxes(corners: Tensor, faces: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Faces [n, 3] that may cover a pixel centre, the first (column, row) [n, 2] of their boxes, the sizes [n, 2]."""
    z = corners[:, 2]
    ahead = z > 1e-9
    safe = z.where(ahead, 1.0)
    # pixel centres are the integers of these coordinates
    x = corners[:, 0] / safe * camera.fx + (camera.cx - 0.5)
    y = corners[:, 1] / safe * camera.fy + (camera.cy - 0.5)
    whole, crossing = faces, faces[:0]
    if not bool(ahead.all()):
        count = ahead[faces].sum(dim=1)
        whole, crossing = faces[count == 3], faces[(count > 0) & (count < 3)]
    # most faces of a fine mesh lie between two columns or two rows of pixel centres: drop them on integers, cheaply
    for values, end in ((x, camera.width), (y, camera.height)):
        cell = values.clamp(-1, end).floor().to(torch.int32)
        c0, c1, c2 = (cell[whole[:, i]] for i in range(3))
        whole = whole[(c0 != c1) | (c1 != c2)]
    low, high = [], []
    for values, end in ((x, camera.width), (y, camera.height)):
        at = values[whole]
        # faces that cross the camera plane: the whole image
        lowest = (at.amin(dim=1) - 1e-6).ceil().clamp(0, end).long()
        low.append(torch.cat([lowest, lowest.new_zeros(len(crossing))]))
        highest = (at.amax(dim=1) + 1e-6).floor().clamp(-1, end - 1).long()
        high.append(torch.cat([highest, highest.new_full((len(crossing),), end - 1)]))
    first, size = torch.stack(low, dim=1), torch.stack(high, dim=1) - torch.stack(low, dim=1) + 1
    hit = (size > 0).all(dim=1)
    return torch.cat([whole, crossing])[hit], first[hit], size[hit]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross products of rows; b x a is exactly -(a x b), which a product with fused multiply-adds is not."""
    (ax, ay, az), (bx, by, bz) = a.unbind(dim=1), b.unbind(dim=1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], dim=1)


def _draw(buffer: Tensor, corners: Tensor, low: Tensor, size: Tensor, camera: Camera) -> None:
    """Draw faces with camera-frame corners [n, 3, 3] over their boxes into the buffer."""
    a, b, c = corners.unbind(dim=1)
    edges = torch.stack([_cross(b, c), _cross(c, a), _cross(a, b)], dim=1)  # [n, 3, 3]
    determinant = (a * edges[:, 0]).sum(dim=1)
    counts = size.prod(dim=1)
    face = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    within = torch.arange(len(face), device=counts.device) - (counts.cumsum(0) - counts)[face]
    columns = size[face, 0]
    column = low[face, 0] + within % columns
    row = low[face, 1] + torch.div(within, columns, rounding_mode="floor")
    x = (column + 0.5 - camera.cx) / camera.fx
    y = (row + 0.5 - camera.cy) / camera.fy
    e = edges[face]
    weights = [e[:, i, 0] * x + e[:, i, 1] * y + e[:, i, 2] for i in range(3)]
    total = weights[0] + weights[1] + weights[2]
    inside = ((weights[0] >= 0) & (weights[1] >= 0) & (weights[2] >= 0)) | (
        (weights[0] <= 0) & (weights[1] <= 0) & (weights[2] <= 0)
    )
    z = determinant[face] / total  # r z lies in the plane of the face
    good = inside & (total != 0) & (z > 0)
    at = row * camera.width + column
    buffer.scatter_reduce_(0, at[good], z[good], "amin")


def visible_counts(
    points: np.ndarray,
    mesh: Mesh,
    cameras: Sequence[Camera],
    *,
    tolerance: float,
    max_side: int = 800,
    device: str = "cpu",
    workers: int | None = None,
) -> np.ndarray:
    """In how many views each point [P, 3] is visible, the mesh being the only thing that hides it.

    A point is visible where it lies in the image and no deeper than ``tolerance`` wu behind the deepest of the 3x3
    pixels around it: the neighbours spare surfaces seen at a slant, whose depth changes within a pixel.

    Parameters
    ----------
    max_side : int
        Images are drawn at most this large, px.
    device : str
        Where torch draws them.
    workers : int, optional
        Images at a time on the CPU; default: as many as it has threads.

    Returns
    -------
    ndarray [P] int64
    """
    vertices, faces = _tensors(mesh, device)
    where = tensor_on(device, points)

    def visible(camera: Camera) -> Tensor:
        small = _shrunk(camera, max_side)
        depths = _depths(vertices, faces, small)
        deepest = torch.nn.functional.max_pool2d(depths[None, None], 3, stride=1, padding=1).view(-1)
        inside, pixel, z = _in_image(where, small)
        return inside & (z <= deepest[pixel] + tolerance)

    counts = torch.zeros(len(points), dtype=torch.int64, device=device)
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        for seen in (map if on_gpu(device) else pool.map)(visible, cameras):
            counts += seen
    return np.asarray(counts.cpu().numpy())


def frustum_counts(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """In how many images each point [P, 3] lies, whatever is before it."""
    where = tensor_on("cpu", points)
    counts = torch.zeros(len(points), dtype=torch.int64)
    for camera in cameras:
        counts += _in_image(where, camera)[0]
    return np.asarray(counts.numpy())


def _in_image(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Which points [P] lie in the image, in which pixel (0 where in none), at what depth."""
    x, y, z = _in_camera(points, camera).unbind(dim=1)
    safe = z.where(z > 1e-12, 1e-12)
    u, v = camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy
    inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    pixel = v.where(inside, 0).long() * camera.width + u.where(inside, 0).long()
    return inside, pixel, z


def _shrunk(camera: Camera, max_side: int) -> Camera:
    factor = max(camera.width, camera.height) / max_side
    if factor <= 1:
        return camera
    return camera.resized(max(1, round(camera.width / factor)), max(1, round(camera.height / factor)))
