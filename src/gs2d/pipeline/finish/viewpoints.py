"""Viewpoints for splats that come without photographs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy import ndarray

from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.data.subject_box import MARGIN, TAIL
from gs2d.errors import DataError
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings

SIZES = (256, 1000)  # px: smallest and largest width and height of the images
SPLAT_PIXELS = 4.0  # px between neighbouring splats on the surface
TRIED = 160  # px: size of the images that choose the cameras
POINTS = 50_000  # splats whose visibility chooses the cameras
FOCAL = 1.2  # of the width
VIEWS = 48  # directions around the subject: neighbours are 29 degrees apart
CORE = 3.0  # times the median distance from the centre: splats farther away are surroundings
RADIUS = 95.0  # percentile of these distances: radius of the subject
STEPS = 10  # of the search for the centre
FAINT = 0.1  # opacity below which a splat is no surface
SURFACE = 0.05  # of the radius: depth of a surface behind which splats are hidden
AS_MUCH = 0.7  # of the area visible from outside, that is visible from inside a room: filled objects show a third
HIDDEN = 0.05  # of the same area, that is visible in a room only from inside: a hollow ball shows nothing more
OPPOSITE = -0.85  # cosine between directions that see a surface from both sides
SHEETS = 0.25  # largest part of the surface that is visible from both sides, unless it is an open sheet
LEVEL = 0.1  # sine of the lowest elevation above an open sheet
INSIDE = 0.3  # of the radius: distance of the cameras in a room from its centre
TURNS = 20  # directions of each camera position in a room
WIDE = 0.5  # focal length in a room, of the width: 90 degrees
_AXES = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """Cameras for splats."""

    cameras: tuple[Camera, ...]
    box: ndarray | None  # [2, 3] world units, of the subject that they surround; None in a room
    why: str  # reason, in a few words


def choose_viewpoints(splats: Splats, settings: RasterSettings, backend: Backend) -> Viewpoints:
    """Return cameras that show the subject of splats from all visible sides.

    The subject is where the splats are densest. Cameras on a sphere around it look at its centre. If cameras in its
    middle see about as much, and surfaces that are hidden from outside, it is a room, and cameras in its middle look
    outwards. A surface that is visible from both sides is an open sheet (a floor, a facade); it is shown from the side
    that shows more. Raises DataError if no splat is opaque enough to be a surface, or all are in one point.
    """
    solid = splats.rows(torch.sigmoid(splats.opacity_logits) > FAINT)
    if len(solid) == 0:
        raise DataError(f"expected splats that are a surface, got {len(splats):,} with opacities below {FAINT}")
    means = solid.means.detach().cpu().numpy().astype(np.float64)
    center, radius = _subject(means)
    if not radius > 0:
        raise DataError(f"expected splats that are a surface, got {len(solid):,} in one point")
    near = np.flatnonzero(np.linalg.norm(means - center, axis=1) <= 1.1 * radius)
    # In images of this size, splats that are evenly spread over the subject are SPLAT_PIXELS apart.
    radii = math.sqrt(len(near) / (4 * math.pi))  # radius of the subject, in distances between splats
    size = int(np.clip(round(SPLAT_PIXELS * radii * math.sqrt(1 + (2 * FOCAL) ** 2) / FOCAL), *SIZES))
    box = np.percentile(means[near], [TAIL, 100 - TAIL], axis=0)
    box += MARGIN * np.ptp(box, axis=0).max() * np.array([[-1], [1]])
    near = near[:: max(1, len(near) // POINTS)]
    points = means[near]
    normals = quats_to_matrices(solid.quats.detach().cpu()).numpy()[near, :, 2].astype(np.float64)
    area = np.exp(solid.log_scales.detach().cpu().numpy()[near].astype(np.float64).sum(axis=1))
    area = np.minimum(area, np.percentile(area, 99))
    directions = _sphere(VIEWS)
    distance = radius * math.sqrt(1 + (2 * FOCAL) ** 2)
    cameras = [_camera(center + distance * d, center, size) for d in directions]
    eyes = center + INSIDE * radius * _AXES
    look = partial(_visible, splats, points, SURFACE * radius, settings, backend)
    visible = np.stack([look(camera) for camera in cameras])
    inside = np.stack([look(_camera(eye, eye + d, size, focal=WIDE)) for eye in eyes for d in _AXES[1:]])
    outer, inner = visible.any(axis=0), inside.any(axis=0)
    least = area[outer].sum()
    if area[inner].sum() > AS_MUCH * least and area[inner & ~outer].sum() > HIDDEN * least:
        around = [_camera(eye, eye + d, size, focal=WIDE) for eye in eyes for d in _sphere(TURNS)]
        return Viewpoints(tuple(around), None, "in the middle of the splats, which surround it")
    opposite = (directions @ directions.T < OPPOSITE).astype(np.float32)
    sheet = (visible & (opposite @ visible.astype(np.float32) > 0)).any(axis=0)
    if area[sheet].sum() <= SHEETS * area.sum():
        return Viewpoints(tuple(cameras), box, "around the subject, from all sides")
    axis = np.linalg.eigh((normals[sheet].T * area[sheet]) @ normals[sheet])[1][:, 2]
    sides = [directions @ up >= LEVEL for up in (axis, -axis)]
    chosen = max(sides, key=lambda side: float(area[visible[side].any(axis=0)].sum()))
    selected = tuple(camera for camera, is_chosen in zip(cameras, chosen, strict=True) if is_chosen)
    return Viewpoints(selected, box, "around the subject, from the side of its ground or wall that shows more")


def _subject(means: ndarray) -> tuple[ndarray, float]:
    """Return the centre and the radius of the densest part of points [N, 3]: a median that ignores surroundings."""
    center = np.median(means, axis=0)
    near = np.ones(len(means), bool)
    for _ in range(STEPS):
        distance = np.linalg.norm(means - center, axis=1)
        near = distance <= CORE * np.median(distance[near])
        center = np.median(means[near], axis=0)
    return center, float(np.percentile(np.linalg.norm(means[near] - center, axis=1), RADIUS))


def _sphere(count: int) -> ndarray:
    """Return directions [count, 3], evenly spread (a Fibonacci lattice)."""
    k = np.arange(count)
    z, turn = 1 - (2 * k + 1) / count, k * np.pi * (3 - math.sqrt(5))
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def _camera(eye: ndarray, target: ndarray, size: int, *, focal: float = FOCAL) -> Camera:
    along = target - eye
    up = np.eye(3)[int(np.abs(along).argmin())]
    return look_at(eye, target, up, width=size, height=size, fx=focal * size)


def _visible(
    splats: Splats, points: ndarray, depth: float, settings: RasterSettings, backend: Backend, camera: Camera
) -> ndarray:
    """Return which points [P, 3] a camera sees, at most ``depth`` behind the rendered surface."""
    small = camera.resized(TRIED, TRIED)
    with torch.no_grad():
        output = rasterize(splats, small, settings, backend=backend)
    surface = torch.where(output.alpha >= 0.5, output.depth_median, torch.inf).cpu().numpy()
    x, y, z = small.rotation @ points.T + small.T_cam_world[:3, 3:]
    z[~(z > 0)] = np.nan
    column, row = np.floor(small.fx * x / z + small.cx), np.floor(small.fy * y / z + small.cy)
    inside = (column >= 0) & (row >= 0) & (column < TRIED) & (row < TRIED)
    visible = np.zeros(len(points), bool)
    visible[inside] = z[inside] <= surface[row[inside].astype(int), column[inside].astype(int)] + depth
    return visible
