"""Render synthetic drone captures: photographs in flight lines over land with a known surface."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.flight_files import flight_exif, write_model
from benchmarks.land import TILE, Land, build_land, shade
from gs2d.contrib.demo.textures import linear_to_srgb
from gs2d.core.atomic_files import disk_error
from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from gs2d.errors import DataError
from gs2d.io.meshes import write_mesh
from gs2d.meshing.raycast import Hits, cast_camera

HEIGHT = 80.0  # m, flight altitude above the mean ground height
ANGLE = np.radians(60.0)  # horizontal field of view
FORWARD, SIDE = 0.8, 0.7  # overlap of consecutive photographs, and of neighbouring lines
TILT = np.radians(15.0)  # camera tilt from nadir, forward and backward on alternating lines: shows walls
LEAST_TRACK = 3  # minimum number of photographs per sparse point
OBSERVATIONS = 200  # maximum number of sparse points per photograph
PIXEL_NOISE = 0.3  # px, standard deviation of point observations
_SAMPLES = 2  # rays per pixel along each axis


@dataclass(frozen=True)
class Flight:
    """Parameters of a synthetic flight.

    Attributes
    ----------
    photographs : int
    width, height : int, px
    points : int or None
        Number of sparse points before points visible in fewer than three photographs are removed; None: 40 per
        photograph.
    side : float or None, m
        Approximate side of the area flown over. None: it grows with the number of photographs, with 80 % forward and
        70 % side overlap.
    land : float or None, m
        Minimum side of the land. None: the land extends beyond the visible area. Land smaller than the area flown
        over is visible as a whole for any number of photographs.
    seed : int
    latitude, longitude, altitude : float
        Origin, degrees and m.
    gps_noise : float, m
        Standard deviation of the EXIF positions along each axis.
    """

    photographs: int
    width: int = 320
    height: int = 240
    points: int | None = None
    side: float | None = None
    land: float | None = None
    seed: int = 0
    latitude: float = 47.05
    longitude: float = 8.3
    altitude: float = 500.0
    gps_noise: float = 1.5

    @property
    def focal(self) -> float:
        """Return the focal length, px."""
        return self.width / 2 / float(np.tan(ANGLE / 2))

    @property
    def pixel(self) -> float:
        """Return the width of a pixel on the ground, m."""
        return HEIGHT / self.focal


@dataclass(frozen=True, eq=False)
class _Photograph:
    """Sparse points of a photograph: point indices [n], pixel positions [n, 2] and colours [n, 3]."""

    points: np.ndarray
    pixels: np.ndarray
    colors: np.ndarray


def write_flight(
    folder: str | os.PathLike[str],
    flight: Flight,
    *,
    on_progress: Callable[[int, int], None] | None = None,
    threads: int | None = None,
) -> None:
    """Write photographs with GPS positions, ground-truth cameras, COLMAP sparse points and the true surface.

    Writes ``images/*.jpg``, ``mesh_gt.ply`` and ``sparse/0/*.bin``; the model is written last, so that an unfinished
    capture is not mistaken for a complete one. The frame is east-north-up in metres from the flight's origin. The
    number of lines makes the land approximately square; its area grows with the number of photographs. Output depends
    only on the arguments, not on the number of threads.

    Parameters
    ----------
    folder : path
        Created if missing; files of an earlier capture are replaced.
    flight : Flight
    on_progress : callable, optional
        Called occasionally with (finished photographs, all photographs), from the calling thread.
    threads : int, optional
        Default: the number of cores, at most 8.

    Raises
    ------
    DataError
        If there are fewer than two photographs, or they are smaller than 16 px.
    DiskError
        If a file cannot be written.
    """
    if flight.photographs < 2 or min(flight.width, flight.height) < 16:
        raise DataError(
            "a flown capture needs at least 2 photographs of 16 px, "
            f"got {flight.photographs} of {flight.width}x{flight.height}"
        )
    root = Path(folder)
    model = root / "sparse" / "0"
    for part in (root / "images", model):
        try:
            part.mkdir(parents=True, exist_ok=True)
            for old in part.iterdir():
                old.unlink()
        except OSError as error:
            raise disk_error(part, error) from error
    cameras = flown_cameras(flight)
    land = build_land(flight.land or _side(cameras), flight.pixel, flight.seed)
    points = sparse_points(land, cameras, flight)
    seen = _photograph(root / "images", land, cameras, points, flight, on_progress, threads)
    vertices, faces = land.mesh()
    write_mesh(root / "mesh_gt.ply", Mesh(vertices, faces.astype(np.int32)))
    tracks = [(photograph.points, photograph.pixels) for photograph in seen]
    colors = _point_colors(len(points), seen)
    names = [image_name(k) for k in range(len(cameras))]
    write_model(model, cameras, names, points, colors, tracks, least=LEAST_TRACK)


def image_name(number: int) -> str:
    """Return the file name of the photograph with this index."""
    return f"{number:06d}.jpg"


def flown_cameras(flight: Flight) -> list[Camera]:
    """Return cameras in alternating lines along x, with small random motion; every other line looks backward."""
    across = HEIGHT * 2 * np.tan(ANGLE / 2)
    along = across * flight.height / flight.width
    step, gap = along * (1 - FORWARD), across * (1 - SIDE)
    lines = max(1, round(np.sqrt(flight.photographs * step / gap)))
    each = -(-flight.photographs // lines)
    if flight.side is not None:
        step, gap = step * flight.side / (each * step), gap * flight.side / (lines * gap)
    rng = np.random.default_rng([flight.seed, 1])
    cameras = []
    for k in range(flight.photographs):
        line, place = divmod(k, each)
        heading = 1.0 if line % 2 == 0 else -1.0
        x = heading * (place - (each - 1) / 2) * step
        y = (line - (lines - 1) / 2) * gap
        eye = np.array([x, y, HEIGHT]) + rng.normal(0, 0.5, 3)
        ahead = np.tan(TILT if (line // 2) % 2 == 0 else -TILT) * heading
        direction = np.array([ahead, 0.0, -1.0]) + rng.normal(0, 0.02, 3)
        up = np.array([heading, rng.normal(0, 0.02), 0.0])
        cameras.append(look_at(eye, eye + direction, up, width=flight.width, height=flight.height, fx=flight.focal))
    return cameras


def _side(cameras: list[Camera]) -> float:
    """Return a land side, m, beyond which no photograph shows anything."""
    reach = HEIGHT * 1.3 * np.tan(ANGLE / 2 + TILT) + TILE
    return float(2 * (np.abs([camera.center[:2] for camera in cameras]).max() + reach))


def sparse_points(land: Land, cameras: list[Camera], flight: Flight) -> np.ndarray:
    """Sample points [P, 3] on the surface below the flight, uniform by area, sorted by tiles."""
    rng = np.random.default_rng([flight.seed, 2])
    count = 40 * flight.photographs if flight.points is None else flight.points
    flown = np.abs([camera.center[:2] for camera in cameras]).max(axis=0) + HEIGHT * np.tan(ANGLE / 2)
    below = (np.abs(land.corners.mean(axis=1)[:, :2]) < flown).all(axis=1)
    a, b, c = (land.corners[below, k] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = np.sort(rng.choice(len(area), size=count, p=area / area.sum()))
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    w = np.stack([1 - u, u * (1 - v), u * v], axis=1)[:, :, None]
    return np.asarray(a[face] * w[:, 0] + b[face] * w[:, 1] + c[face] * w[:, 2])


def _photograph(
    folder: Path,
    land: Land,
    cameras: list[Camera],
    points: np.ndarray,
    flight: Flight,
    on_progress: Callable[[int, int], None] | None,
    threads: int | None,
) -> list[_Photograph]:
    tile = ((points[:, :2] - land.low) // TILE).astype(np.int64)
    number = tile[:, 1] * land.tiles + tile[:, 0]
    order = np.argsort(number, kind="stable")
    rank = np.random.default_rng([flight.seed, 5]).permutation(len(points))
    index = _PointIndex(points[order], order, number[order], rank, land)
    _ = land.normals, land.heights  # compute before threads use them

    def shoot(number: int) -> _Photograph:
        camera = cameras[number]
        low, high = footprint(land, camera)
        chosen = land.near(low - TILE, high + TILE)
        corners = land.corners[chosen].reshape(-1, 3)
        hits = cast_camera(corners, np.arange(len(corners)).reshape(-1, 3), camera, samples=_SAMPLES)
        pixels = picture(land, chosen, hits, flight)
        _write_photograph(folder / image_name(number), pixels, flight, camera, number)
        return index.seen(camera, hits, low, high, pixels, np.random.default_rng([flight.seed, 3, number]))

    seen = []
    with ThreadPoolExecutor(threads or min(os.cpu_count() or 1, 8)) as pool:
        for done, photograph in enumerate(pool.map(shoot, range(len(cameras))), start=1):
            seen.append(photograph)
            if on_progress is not None and (done % 20 == 0 or done == len(cameras)):
                on_progress(done, len(cameras))
    return seen


def footprint(land: Land, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return two corners [2], [2] of the ground rectangle that contains a camera's visible area, m."""
    u, v = (np.array([0.0, size]) for size in (camera.width, camera.height))
    rays = np.array([[(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0] for x in u for y in v])
    world = rays @ camera.rotation
    places = []
    for z in land.heights:
        places.append(camera.center[:2] + world[:, :2] * ((z - camera.center[2]) / world[:, 2])[:, None])
    corners = np.concatenate(places)
    return corners.min(axis=0), corners.max(axis=0)


def picture(land: Land, chosen: np.ndarray, hits: Hits, flight: Flight) -> np.ndarray:
    """Render a photograph, uint8 [H, W, 3]: the mean linear colour over the rays of each pixel, as sRGB."""
    there = hits.face >= 0
    face = hits.face[there]
    weights, corners = hits.weights[there], land.corners[chosen[face]]
    place = sum(weights[:, k, None] * corners[:, k] for k in range(3))
    color = np.full((*hits.face.shape, 3), 0.6, np.float32)
    color[there] = shade(land, chosen[face], place)
    rays = [color[row::_SAMPLES, column::_SAMPLES] for row in range(_SAMPLES) for column in range(_SAMPLES)]
    return np.round(linear_to_srgb(np.add.reduce(rays) / len(rays)) * 255).astype(np.uint8)


def _write_photograph(path: Path, pixels: np.ndarray, flight: Flight, camera: Camera, number: int) -> None:
    rng = np.random.default_rng([flight.seed, 4, number])
    place = camera.center + rng.normal(0, flight.gps_noise, 3) if flight.gps_noise else camera.center
    origin = (flight.latitude, flight.longitude, flight.altitude)
    try:
        Image.fromarray(pixels).save(path, quality=95, exif=flight_exif(place, origin, number, ANGLE))
    except OSError as error:
        raise disk_error(path, error) from error


@dataclass(frozen=True, eq=False)
class _PointIndex:
    """Sparse points [P, 3] grouped by tile, with their indices, tiles and detection ranks [P]."""

    places: np.ndarray
    numbers: np.ndarray
    tile: np.ndarray
    rank: np.ndarray
    land: Land

    def seen(
        self,
        camera: Camera,
        hits: Hits,
        low: np.ndarray,
        high: np.ndarray,
        pixels: np.ndarray,
        rng: np.random.Generator,
    ) -> _Photograph:
        """Return a subset of the points that are visible to a camera, that is, on the surface hit by its rays."""
        land = self.land
        first = np.clip(((low - land.low) // TILE).astype(int), 0, land.tiles - 1)
        last = np.clip(((high - land.low) // TILE).astype(int), 0, land.tiles - 1)
        rows = np.arange(first[1], last[1] + 1) * land.tiles
        begin, end = np.searchsorted(self.tile, rows + first[0]), np.searchsorted(self.tile, rows + last[0], "right")
        near = np.concatenate([np.arange(b, e) for b, e in zip(begin, end, strict=True)])
        at, z = camera.project(self.places[near])
        inside = (z > 0) & (at >= 1).all(axis=1) & (at < (camera.width - 1, camera.height - 1)).all(axis=1)
        near, at, z = near[inside], at[inside], z[inside]
        column, row = (at * _SAMPLES).astype(int).T
        visible = np.abs(hits.depth[row, column] - z) < max(0.3, 2 * HEIGHT / camera.fx)
        near, at = near[visible], at[visible]
        if len(near) > OBSERVATIONS:
            kept = np.sort(np.argsort(self.rank[near])[:OBSERVATIONS])  # neighbouring images choose the same points
            near, at = near[kept], at[kept]
        column, row = at.astype(int).T
        colors = pixels[row, column]
        return _Photograph(self.numbers[near], at + rng.normal(0, PIXEL_NOISE, at.shape), colors)


def _point_colors(count: int, seen: list[_Photograph]) -> np.ndarray:
    """Return the colour uint8 [P, 3] of each point in the first photograph that shows it."""
    colors = np.full((count, 3), 128, np.uint8)
    for photograph in reversed(seen):
        colors[photograph.points] = photograph.colors
    return colors
