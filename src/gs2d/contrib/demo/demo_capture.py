"""The capture of the demo: a still life with an exactly known mesh, rendered by ray casting."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gs2d.contrib.demo.demo_scene import ToyScene, build_scene
from gs2d.contrib.demo.shading import BakedLight, bake, shade
from gs2d.contrib.demo.shapes import merge_vertices
from gs2d.contrib.demo.textures import linear_to_srgb
from gs2d.core.atomic_files import atomic_write
from gs2d.core.camera import Camera, look_at
from gs2d.core.json_files import write_json
from gs2d.core.mesh import Mesh
from gs2d.data.image_files import write_image
from gs2d.errors import DataError
from gs2d.io.meshes import write_mesh
from gs2d.io.run_dir import make_folder
from gs2d.meshing.raycast import cast_camera

CAMERA_ANGLE_X = 0.6911112  # radians, the horizontal field of view of NeRF-Synthetic
_SAMPLES = 4  # rays per pixel along each axis
_OPENGL = np.diag([1.0, -1.0, -1.0])  # OpenCV camera axes (y down, z forward) to OpenGL (y up, z back)


@dataclass(frozen=True, eq=False)
class SyntheticImage:
    """One rendered view."""

    rgba: np.ndarray  # [H, W, 4] uint8 sRGB, straight alpha; colour is 0 where alpha is 0
    visible: np.ndarray  # [F] bool: visible triangles


def write_demo_capture(
    folder: str | os.PathLike[str],
    *,
    seed: int = 0,
    train_views: int = 40,
    test_views: int = 8,
    size: int = 256,
    on_progress: Callable[[int, int], None] | None = None,
    threads: int | None = None,
) -> None:
    """Write a small synthetic capture in the NeRF-Synthetic layout, with the mesh that was rendered.

    Writes RGBA PNG of ``size`` x ``size`` px in ``train/`` and ``test/``, ``mesh_gt.ply``, ``mesh_gt_seen.npy`` (number
    of training views that see each face, uint8) and, last, ``transforms_{train,test}.json``; files of an earlier
    capture are replaced. Deterministic for any number of ``threads`` (default: the cores, at most 8). The seed is for
    the twigs, the textures, and small motions of the cameras. ``on_progress`` gets (images done, number of images)
    after each image, from the calling thread.

    Raises DataError if there is no training view, or the size is less than 16 px; DiskError if a file could not be
    written.
    """
    if train_views < 1 or test_views < 0 or size < 16:
        raise DataError(
            f"a demo capture needs at least 1 training view, 0 test views and 16 px, "
            f"got {train_views}, {test_views} and {size}"
        )
    root = Path(folder)
    _make_folders(root, ("train", "test") if test_views else ("train",))
    cameras = demo_cameras(seed, train_views, test_views, size)
    _photograph(root, build_scene(seed), cameras, on_progress, threads)
    _write_cameras(root, cameras)


def _photograph(
    root: Path,
    scene: ToyScene,
    cameras: Mapping[str, Sequence[Camera]],
    on_progress: Callable[[int, int], None] | None,
    threads: int | None,
) -> None:
    """Write images, mesh, and the number of training views that see each face."""
    workers = threads or min(os.cpu_count() or 1, 8)
    light = bake(scene.patch, threads=workers)
    jobs = [(split, k, camera) for split, split_cameras in cameras.items() for k, camera in enumerate(split_cameras)]

    def image(job: tuple[str, int, Camera]) -> np.ndarray:
        split, k, camera = job
        result = render_image(scene, light, camera)
        write_image(root / split / f"r_{k}.png", result.rgba)
        return result.visible

    counts = np.zeros(len(scene.patch.faces), dtype=np.int64)
    with ThreadPoolExecutor(workers) as pool:
        for done, ((split, _, _), visible) in enumerate(zip(jobs, pool.map(image, jobs), strict=True)):
            counts += visible & (split == "train")
            if on_progress is not None:
                on_progress(done + 1, len(jobs))

    write_mesh(root / "mesh_gt.ply", demo_mesh(scene))
    with atomic_write(root / "mesh_gt_seen.npy") as file:
        np.save(file, np.minimum(counts, 255).astype(np.uint8))


def _write_cameras(root: Path, cameras: Mapping[str, Sequence[Camera]]) -> None:
    for split in ("test", "train"):  # the last file marks the capture as complete
        if cameras.get(split):
            write_json(root / f"transforms_{split}.json", _transforms(split, cameras[split]))


def _make_folders(root: Path, splits: tuple[str, ...]) -> None:
    for split in splits:
        make_folder(root / split)
    (root / "transforms_train.json").unlink(missing_ok=True)


def demo_mesh(scene: ToyScene) -> Mesh:
    """Return the rendered triangles, in the same order, with vertices merged across texture seams."""
    vertices, faces = merge_vertices(scene.patch.vertices, scene.patch.faces)
    return Mesh(vertices, faces.astype(np.int32))


def demo_cameras(seed: int, train_views: int, test_views: int, size: int) -> dict[str, list[Camera]]:
    """Return cameras around the scene, spread by the golden angle at elevations of -8 to 74 (test: 6 to 64) degrees."""
    rng = np.random.default_rng([seed, 1])
    return {
        "train": _spiral(rng, train_views, size, lowest=-8.0, highest=74.0, start=0.0),
        "test": _spiral(rng, test_views, size, lowest=6.0, highest=64.0, start=0.9),
    }


def _spiral(
    rng: np.random.Generator, count: int, size: int, *, lowest: float, highest: float, start: float
) -> list[Camera]:
    """Return cameras with uniform density on the sphere between two elevations, degrees."""
    low, high = np.sin(np.radians([lowest, highest]))
    cameras = []
    for k in range(count):
        z = low + (high - low) * (k + 0.5) / count
        azimuth = start + np.pi * (1 + np.sqrt(5)) * k
        towards = np.array([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z])
        eye = towards * rng.uniform(3.75, 4.0)
        roll = rng.uniform(-0.05, 0.05)
        side = np.cross(towards, [0, 0, 1.0])
        up = np.array([0, 0, 1.0]) * np.cos(roll) + side / np.linalg.norm(side) * np.sin(roll)
        target = rng.uniform(-0.04, 0.04, 3)
        cameras.append(look_at(eye, target, up, width=size, height=size, fx=size / 2 / np.tan(CAMERA_ANGLE_X / 2)))
    return cameras


def _transforms(split: str, cameras: Sequence[Camera]) -> dict[str, object]:
    """Return the content of transforms_<split>.json: OpenGL camera-to-world matrices."""
    frames = []
    for k, camera in enumerate(cameras):
        T_world_cam = np.eye(4)
        T_world_cam[:3, :3] = camera.rotation.T @ _OPENGL
        T_world_cam[:3, 3] = camera.center
        frames.append({"file_path": f"./{split}/r_{k}", "transform_matrix": T_world_cam.tolist()})
    return {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}


def render_image(scene: ToyScene, light: BakedLight, camera: Camera) -> SyntheticImage:
    """Render one view: the mean of premultiplied linear colour over the rays of each pixel, stored as sRGB."""
    hits = cast_camera(scene.patch.vertices, scene.patch.faces, camera, samples=_SAMPLES)
    visible = np.zeros(len(scene.patch.faces), dtype=bool)
    visible[hits.face[hits.face >= 0]] = True
    alpha = _pixel_means((hits.face >= 0).astype(np.float64)[..., None])
    color = _pixel_means(np.minimum(shade(scene, light, hits, camera.center), 1.0).astype(np.float64))
    rgba = np.concatenate([linear_to_srgb(color / np.maximum(alpha, 1e-12)) * (alpha > 0), alpha], axis=2)
    return SyntheticImage(np.round(rgba * 255).astype(np.uint8), visible)


def _pixel_means(rays: np.ndarray) -> np.ndarray:
    """Average blocks of rays [H * samples, W * samples, C] to pixels [H, W, C]."""
    height, width, channels = rays.shape
    blocks = rays.reshape(height // _SAMPLES, _SAMPLES, width // _SAMPLES, _SAMPLES, channels)
    return np.asarray(blocks.mean(axis=(1, 3)))
