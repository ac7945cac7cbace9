"""Upper bound of mesh quality: fusing exact depth maps of a scanned object (ray-cast by Embree) gives its surface."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gs2d.contrib.lab.surface_score import evaluate_surface
from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.io.meshes import read_mesh
from gs2d.meshing.depth_maps import RenderedView
from gs2d.meshing.extract import extract

SIZE = 200


def cameras_of(folder: Path) -> list[Camera]:
    """Return every second training camera of the NeRF-Synthetic file, at half resolution."""
    info = json.loads((folder / "transforms_train.json").read_text())
    focal = 0.5 * SIZE / np.tan(0.5 * info["camera_angle_x"])
    flip = np.diag([1.0, -1, -1, 1])  # OpenGL axes to OpenCV axes
    poses = [np.linalg.inv(np.array(f["transform_matrix"]) @ flip) for f in info["frames"][::2]]
    return [Camera(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2, T) for T in poses]


def ray_cast(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Return z-depth [H, W] computed by trimesh and Embree; 0 where the ray hits nothing."""
    pyembree = pytest.importorskip("trimesh.ray.ray_pyembree")
    caster = pyembree.RayMeshIntersector(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False))
    v, u = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1).reshape(-1, 3)
    step = local @ camera.rotation  # unit depth
    face = caster.intersects_first(np.broadcast_to(camera.center, step.shape), step)
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.faces[face]], 1, 0)
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = ((a - camera.center) * normal).sum(1) / (step * normal).sum(1)
    return np.where(face >= 0, depth, 0).reshape(SIZE, SIZE)


def test_exact_depth_of_the_bottle_scene_reproduces_its_surface(shared: Callable[[str], Path]) -> None:
    folder = shared("rendered_bottle")
    truth, seen = read_mesh(folder / "mesh_gt.ply"), np.load(folder / "mesh_gt_seen.npy")
    cameras = cameras_of(folder)
    result = extract([RenderedView(c, ray_cast(truth, c)) for c in cameras], threads=1)
    assert result.limits.voxel == pytest.approx(0.007, abs=0.001)  # half a pixel: 4 / 278 / 2
    assert result.limits.truncation == pytest.approx(5 * result.limits.voxel)  # exact maps agree
    assert result.limits.cut_fraction == 0
    score = evaluate_surface(result.mesh, truth, cameras=cameras, view_counts=seen, samples=30_000)
    assert score.mesh_hidden < 0.01
    assert [s.f_score > least for s, least in zip(score.scores, (0.98, 0.99, 0.995), strict=True)] == [True] * 3
    assert score.chamfer is not None
    assert score.chamfer < 0.3 * result.limits.voxel
