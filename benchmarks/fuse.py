"""Measure fusion and marching cubes on seeded depth maps: wall time, CPU time and memory.

::

    python -m benchmarks.fuse [--views 60] [--size 400] [--resolution 512] [--threads 2] [--unbounded]
                              [--backend auto] [--json FILE]

The scene is a sphere of radius 0.9 with coloured waves, viewed from all sides; its surface is about as large as that of
``rendered_bottle``. With ``--unbounded`` the same frames are fused into nested levels; the innermost level has half the
side of the sphere and the voxel size of the bounded run. ``--backend cuda`` fuses on a GPU. Compare CPU times on a
shared machine.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from benchmarks.timing import machine
from gs2d.contrib.surfaces.unbounded import derive_cascade, find_cascade_blocks, fused_cascade_surface
from gs2d.core.camera import Camera, look_at
from gs2d.kernels.library import load
from gs2d.meshing.consistency import depth_noise
from gs2d.meshing.depth_maps import DepthMap, RenderedView, depth_map
from gs2d.meshing.evidence import gather
from gs2d.meshing.fusion_bounds import derive_limits, sample_depths, widen_truncation
from gs2d.meshing.marching_cubes import keep_components
from gs2d.meshing.slabs import fused_surface
from gs2d.meshing.tsdf_volume import VolumeBlocks, find_blocks, fusion_backend

RADIUS = 0.9
T = TypeVar("T")


@dataclass(frozen=True)
class Result:
    """Cost and output size of one run."""

    views: int
    size: int
    resolution: int
    threads: int
    backend: str
    levels: int
    seconds: dict[str, float]
    cpu_seconds: dict[str, float]
    blocks: int
    volume_mib: float
    vertices: int
    faces: int
    worst_radius_error_voxels: float


def sphere_map(camera: Camera) -> DepthMap:
    """Return depth and colour of the sphere at pixel centres."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    step = local @ camera.rotation  # one unit deep
    a, b = (step * step).sum(-1), step @ camera.center
    inside = b * b - a * (camera.center @ camera.center - RADIUS**2)
    depth = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0)
    color = 0.5 + 0.5 * np.sin(20 * (camera.center + depth[..., None] * step))
    return depth_map(RenderedView(camera, depth, color, depth > 0))


def orbit(count: int, size: int) -> list[Camera]:
    """Return cameras on all sides at distance 4, as for ``rendered_bottle``."""
    k = np.arange(count)
    z = 1 - 2 * (k + 0.5) / count
    angle = k * np.pi * (3 - 5**0.5)
    r = np.sqrt(1 - z * z)
    eyes = 4 * np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    up = np.array([0.1, 0.2, 1.0])
    return [look_at(eye, np.zeros(3), up, width=size, height=size, fx=1.4 * size) for eye in eyes]


def run(
    views: int, size: int, resolution: int, threads: int, *, unbounded: bool = False, backend: str = "auto"
) -> Result:
    """Fuse once, step by step."""
    wall: dict[str, float] = {}
    cpu: dict[str, float] = {}

    def timed(name: str, work: Callable[[], T]) -> T:
        clock, processor = time.perf_counter(), time.process_time()
        value = work()
        wall[name] = round(time.perf_counter() - clock, 3)
        cpu[name] = round(time.process_time() - processor, 3)
        return value

    load().use_threads(threads)
    cameras = orbit(views, size)
    maps = [sphere_map(camera) for camera in cameras]
    samples = timed("sample", lambda: [sample_depths(item) for item in maps])
    limits = timed("limits", lambda: derive_limits(samples, cameras, resolution=resolution))
    noise = timed("noise", lambda: depth_noise(maps, samples, limits))
    limits = widen_truncation(limits, noise)
    levels: tuple[VolumeBlocks, ...]
    if unbounded:
        core = np.array([[-RADIUS] * 3, [RADIUS] * 3]) / 2
        cascade = derive_cascade(samples, cameras, bbox=core, voxel=limits.voxel, truncation=limits.truncation)
        levels = timed("blocks", lambda: find_cascade_blocks(maps, cascade))
        mesh = timed(
            "fuse",
            lambda: fused_cascade_surface(maps, cascade, levels, far_weight=1.0, backend=backend),
        )
    else:
        levels = timed("blocks", lambda: (find_blocks(maps, limits),))
        mesh = timed("fuse", lambda: fused_surface(maps, limits, levels[0], backend=backend))
    mesh = timed("components", lambda: keep_components(mesh))
    timed("evidence", lambda: gather(mesh, maps, limits.truncation))
    error = np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).max() / limits.voxel
    return Result(
        views=views,
        size=size,
        resolution=resolution,
        threads=threads,
        backend=fusion_backend(backend).name,
        levels=len(levels),
        seconds=wall,
        cpu_seconds=cpu,
        blocks=sum(len(level.keys) for level in levels),
        volume_mib=round(sum(level.nbytes for level in levels) / 2**20, 1),
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        worst_radius_error_voxels=round(float(error), 3),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the result, and write it to ``--json`` if requested."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--resolution", type=int, default=512)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--unbounded", action="store_true")
    parser.add_argument("--backend", default="auto", choices=("auto", "cpu", "cuda"))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    result = run(
        options.views,
        options.size,
        options.resolution,
        options.threads,
        unbounded=options.unbounded,
        backend=options.backend,
    )
    document = {"machine": machine(), "result": asdict(result)}
    print(json.dumps(document, indent=1))
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
