"""``gs2d survey --orthophoto``: orthophoto and elevation model of a georeferenced run as GeoTIFF."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.contrib.survey.georeference import Georeference, required_georeference
from gs2d.contrib.survey.geotiff import NO_DATA, write_geotiff
from gs2d.contrib.survey.survey_commands import OrthophotoOptions
from gs2d.core.atomic_files import check_writable
from gs2d.core.camera import Camera
from gs2d.core.extras import required
from gs2d.core.mesh import Mesh
from gs2d.errors import ProtocolError, RunError
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import MESH, open_run
from gs2d.meshing.raycast import Hits, cast_camera
from gs2d.meshing.texture import Texels, surface_colors
from gs2d.pipeline.finish.run_texture import photographs
from gs2d.pipeline.prepare.loaded import Trained, open_finished
from gs2d.training.events import OnEvent, Phase, ignore

ELEVATION = "_elevation"  # appended to the name of the orthophoto
MAX_CELLS = 36_000_000  # at about 70 bytes per cell: 2.5 GB
_AUTO_SIDE = 4_000  # largest side of a raster of default resolution, cells
_NICE = (1.0, 2.0, 2.5, 5.0, 10.0)  # default resolutions, times a power of ten


@dataclass(frozen=True)
class Raster:
    """Position and size of a raster."""

    corner: tuple[float, float]  # local x and y of the upper left corner, metres
    step: float  # metres
    size: tuple[int, int]  # rows and columns


def orthophoto_run(
    path: Path,
    out: Path | None = None,
    options: OrthophotoOptions = OrthophotoOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    threads: int | None = None,
) -> dict[str, Any]:
    """Write orthophoto and elevation model of a georeferenced run; returns files and counts.

    A cell shows the highest surface of the mesh, in the colours of the photographs with the best view of it, else those
    of the mesh.
    """
    required("geo", "tifffile", "a GeoTIFF")  # fail early
    path = Path(path)
    place = required_georeference(open_run(path).path)
    target = path / "orthophoto.tif" if out is None else Path(out)
    if target.suffix.lower() not in (".tif", ".tiff"):
        raise RunError(f"--out must end in .tif or .tiff, got {target.name}")
    files = target, target.with_name(target.stem + ELEVATION + target.suffix)
    for file in files:
        check_writable(file)
    if not (path / MESH).is_file():
        raise RunError(f"{path} has no {MESH}; write it with `gs2d mesh {path}`")
    mesh = read_mesh(path / MESH)
    if not len(mesh.faces):
        raise RunError(f"{path / MESH} has no triangles; extract it again with `gs2d mesh {path}`")
    _, job = open_finished(path, threads, on_event)
    local = place.to_local(mesh.vertices)
    raster = _raster(local, options.resolution, _pixel(job, mesh) * place.scale)
    on_event(Phase("rendering from above", 0))
    hits = from_above(local, mesh.faces, raster)
    colors, unseen = _colors(job, mesh, hits, on_event)
    _write(files, colors, _elevations(local, mesh, hits, place), raster, place)
    return {
        "files": [str(file) for file in files],
        "resolution": raster.step,
        "rows": raster.size[0],
        "columns": raster.size[1],
        "cells": int((hits.face >= 0).sum()),
        "cells_unseen": unseen,
        "frame": place.frame,
        "epsg": place.epsg,
    }


def _pixel(job: Trained, mesh: Mesh) -> float:
    """Return the pixel size on the surface, world units: median over the surface, by the nearest view."""
    some = mesh.vertices[:: max(1, len(mesh.vertices) // 2_000)].astype(np.float64)
    size = np.full(len(some), np.inf)
    for view in job.scene.train:
        camera = view.camera
        pixels, depth = camera.project(some)
        shown = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
        size = np.where(shown, np.minimum(size, depth / camera.fx), size)
    visible = np.isfinite(size)
    if not visible.any():
        raise RunError("no photograph shows the mesh; does it belong to this capture?")
    return float(np.median(size[visible]))


def _raster(local: np.ndarray, resolution: float | None, pixel: float) -> Raster:
    """Return the raster of a surface, aligned to multiples of its step; default: the resolution of the photographs."""
    low, high = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
    if resolution is None:
        least = max(pixel, float((high - low).max()) / _AUTO_SIDE)
        power = 10.0 ** math.floor(math.log10(least))
        resolution = next(nice * power for nice in _NICE if nice * power >= least * (1 - 1e-9))
    if not (math.isfinite(resolution) and resolution > 0):
        raise ProtocolError(f"--set resolution must be a positive number of metres, got {resolution:g}")
    first, last = np.floor(low / resolution), np.ceil(high / resolution)
    columns, rows = np.maximum(last - first, 1)
    if rows * columns > MAX_CELLS:
        finest = math.sqrt(float(np.prod(high - low)) / MAX_CELLS)
        raise ProtocolError(
            f"--set resolution={resolution:g} needs {rows * columns:,.0f} cells, more than {MAX_CELLS:,}; "
            f"use {finest:.2g} m or more"
        )
    corner = float(first[0] * resolution), float(last[1] * resolution)
    return Raster(corner, resolution, (int(rows), int(columns)))


def from_above(vertices: np.ndarray, faces: np.ndarray, raster: Raster) -> Hits:
    """Cast a vertical ray through every cell, and return the highest triangle of each; ``depth`` has no meaning.

    The map (x, y, 1) / q, with q linear in the height, keeps planes flat and makes vertical lines the rays of a camera
    whose pixels are the cells; higher points are nearer.
    """
    (rows, columns), (left, top) = raster.size, raster.corner
    x, y, z = vertices.T
    q = np.asarray(1 + (z - z.min()) / max(float(np.ptp(z)), 1e-30), np.float32)
    mapped = np.stack([(x - left) / raster.step, (top - y) / raster.step, np.ones(len(z))], axis=1) / q[:, None]
    hits = cast_camera(mapped, faces, Camera(columns, rows, 1.0, 1.0, 0.0, 0.0, np.eye(4)))
    for k in range(3):  # barycentric coordinates are mapped, too
        hits.weights[..., k] /= q[faces[hits.face, k]]
    total = hits.weights.sum(axis=2, keepdims=True)
    np.divide(hits.weights, total, out=hits.weights, where=total > 0)
    return hits


def _colors(job: Trained, mesh: Mesh, hits: Hits, on_event: OnEvent) -> tuple[np.ndarray, int]:
    """Return colours [H, W, 4] uint8, alpha 0 without surface, and the number of cells not visible in photographs."""
    height, width = hits.face.shape
    index = np.flatnonzero(hits.face.reshape(-1) >= 0)
    texels = Texels(
        width,
        index.astype(np.int32),
        hits.face.reshape(-1)[index],
        np.ascontiguousarray(hits.weights.reshape(-1, 3)[index, :2]),
    )
    images = partial(photographs, job, job.scene.train, on_event)
    colors, visible = surface_colors(mesh, texels, images, threads=torch.get_num_threads())
    if mesh.colors is not None and not visible.all():
        colors[~visible] = np.rint(texels.interpolated(mesh.colors, mesh.faces))[~visible].astype(np.uint8)
    image = np.zeros((height * width, 4), dtype=np.uint8)
    image[index, :3] = colors
    image[index, 3] = 255
    return image.reshape(height, width, 4), int((~visible).sum())


def _elevations(local: np.ndarray, mesh: Mesh, hits: Hits, place: Georeference) -> np.ndarray:
    """Return world heights [H, W] float32, metres; NO_DATA without surface."""
    heights = np.full(hits.face.shape, NO_DATA, dtype=np.float32)
    hit = hits.face >= 0
    corners = local[mesh.faces[hits.face[hit]], 2]  # [M, 3]
    heights[hit] = (corners * hits.weights[hit]).sum(axis=1) + place.origin[2]
    return heights


def _write(
    files: tuple[Path, Path], colors: np.ndarray, heights: np.ndarray, raster: Raster, place: Georeference
) -> None:
    corner = raster.corner[0] + float(place.origin[0]), raster.corner[1] + float(place.origin[1])
    for file, image in zip(files, (colors, heights), strict=True):
        write_geotiff(file, image, corner=corner, step=raster.step, epsg=place.epsg, frame=place.frame)
