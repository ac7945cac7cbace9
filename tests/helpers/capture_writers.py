"""Write small captures in every layout with struct and json, independently of the readers of gs2d."""

from __future__ import annotations

import hashlib
import json
import math
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from gs2d.core.camera import Camera, look_at

MODEL_IDS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9, "THIN_PRISM_FISHEYE": 10,
    "RAD_TAN_THIN_PRISM_FISHEYE": 11, "SIMPLE_FISHEYE": 14, "FISHEYE": 15, "EUCM": 16, "EQUIRECTANGULAR": 17,
}  # fmt: skip


def ring(count: int, *, width: int = 40, height: int = 30, f: float = 35.0, radius: float = 4.0) -> list[Camera]:
    """Return cameras on a circle that look at the origin, z up."""
    angles = np.arange(count) * 2 * math.pi / count
    eyes = [radius * np.array([math.cos(a), math.sin(a), 0.3]) for a in angles]
    up = np.array([0.0, 0.0, 1.0])
    return [look_at(eye, np.zeros(3), up, width=width, height=height, fx=f) for eye in eyes]


def write_image_of(path: Path, width: int = 40, height: int = 30, *, seed: int = 0, alpha: bool = False) -> np.ndarray:
    """Write a random PNG or JPEG and return its pixels before encoding."""
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 4 if alpha else 3)).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return pixels


@dataclass
class ColmapModel:
    """Contents of a COLMAP model."""

    cameras: dict[int, tuple] = field(default_factory=dict)  # id -> (model, width, height, params)
    images: list[tuple] = field(default_factory=list)  # (id, T_cam_world, camera id, name, [(x, y, point id)])
    points: list[tuple] = field(default_factory=list)  # (id, xyz, rgb, error, [(image id, index)])

    def write(self, folder: Path, kind: str = "bin") -> None:
        folder.mkdir(parents=True, exist_ok=True)
        (self._write_bin if kind == "bin" else self._write_txt)(folder)

    def _write_bin(self, folder: Path) -> None:
        out = struct.pack("<Q", len(self.cameras))
        for camera_id, (model, width, height, params) in self.cameras.items():
            out += struct.pack("<IiQQ", camera_id, MODEL_IDS[model], width, height)
            out += struct.pack(f"<{len(params)}d", *params)
        (folder / "cameras.bin").write_bytes(out)
        out = struct.pack("<Q", len(self.images))
        for image_id, T, camera_id, name, observed in self.images:
            out += struct.pack("<I7dI", image_id, *quaternion(T), *T[:3, 3], camera_id) + name.encode() + b"\0"
            out += struct.pack("<Q", len(observed)) + b"".join(struct.pack("<ddq", *o) for o in observed)
        (folder / "images.bin").write_bytes(out)
        out = struct.pack("<Q", len(self.points))
        for point_id, xyz, rgb, error, track in self.points:
            out += struct.pack("<Q3d3Bd", point_id, *xyz, *rgb, error)
            out += struct.pack("<Q", len(track)) + b"".join(struct.pack("<II", *t) for t in track)
        (folder / "points3D.bin").write_bytes(out)

    def _write_txt(self, folder: Path) -> None:
        def line(*words: object) -> str:
            return " ".join(str(w) for w in words) + "\n"

        cameras = "# Camera list\n" + "".join(
            line(i, m, w, h, *map(repr, map(float, p))) for i, (m, w, h, p) in self.cameras.items()
        )
        images = "# Image list with two lines of data per image:\n"
        for i, T, camera_id, name, observed in self.images:
            pose = [repr(float(v)) for v in (*quaternion(T), *T[:3, 3])]
            images += line(i, *pose, camera_id, name) + line(*[v for o in observed for v in o])
        points = "# 3D point list\n" + "".join(
            line(i, *map(repr, map(float, xyz)), *rgb, error, *[v for t in track for v in t])
            for i, xyz, rgb, error, track in self.points
        )
        (folder / "cameras.txt").write_text(cameras)
        (folder / "images.txt").write_text(images)
        (folder / "points3D.txt").write_text(points)


def quaternion(T: np.ndarray) -> tuple[float, ...]:
    """Return (w, x, y, z) of the rotation of T, computed by SciPy."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return float(w), float(x), float(y), float(z)


def small_colmap(
    root: Path, *, count: int = 9, where: str = "sparse/0", kind: str = "bin", **model_args: Any
) -> ColmapModel:
    """Write a ring of PINHOLE cameras with an off-centre principal point; images 0.png, 1.png ... of 40x30."""
    model = ColmapModel(cameras={7: ("PINHOLE", 40, 30, (35.0, 36.0, 18.5, 16.25))})
    for index, camera in enumerate(ring(count)):
        # Written in reverse, with ids that are not indices: readers must sort by name.
        name = f"{count - 1 - index}.png"
        model.images.append((100 + index, camera.T_cam_world, 7, name, [(1.5, 2.5, -1)] * (index % 3)))
        write_image_of(root / "images" / name, seed=index)
    rng = np.random.default_rng(5)
    for index in range(20):
        track = [(100, 0)] * (index % 4)
        model.points.append((index + 1, rng.normal(size=3), tuple(rng.integers(0, 256, 3).tolist()), 0.5, track))
    for key, value in model_args.items():
        setattr(model, key, value)
    model.write(root / where, kind)
    return model


def opengl_camera_to_world(camera: Camera) -> list[list[float]]:
    """Return the matrix that Blender would write for this camera."""
    M = np.linalg.inv(camera.T_cam_world)
    M[:3, 1:3] *= -1
    return M.tolist()


def small_blender(root: Path, *, train: int = 4, test: int = 2, width: int = 40, height: int = 30) -> list[Camera]:
    """Write RGBA images of a ring, with only camera_angle_x and file_path values without extension."""
    cameras = ring(train + test, width=width, height=height)
    for split, chosen in (("train", cameras[:train]), ("test", cameras[train:])):
        frames = []
        for index, camera in enumerate(chosen):
            write_image_of(root / split / f"r_{index}.png", width, height, seed=index, alpha=True)
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": opengl_camera_to_world(camera)})
        meta = {"camera_angle_x": 2 * math.atan(width / 2 / 35.0), "frames": frames}
        if chosen:
            (root / f"transforms_{split}.json").write_text(json.dumps(meta))
    return cameras


def small_nerfstudio(
    root: Path, *, count: int = 9, meta: dict | None = None, frame: dict | None = None
) -> list[Camera]:
    """Write a transforms.json with shared off-centre intrinsics; ``meta`` and ``frame`` extend it and its frames."""
    cameras = ring(count)
    frames = []
    for index, camera in enumerate(cameras):
        write_image_of(root / "images" / f"f_{index:02d}.png", seed=index)
        entry = {"file_path": f"images/f_{index:02d}.png", "transform_matrix": opengl_camera_to_world(camera)}
        frames.append({**entry, **(frame or {})})
    shared = {"fl_x": 35.0, "fl_y": 36.0, "cx": 18.5, "cy": 16.25, "w": 40, "h": 30}
    (root / "transforms.json").write_text(json.dumps({**shared, **(meta or {}), "frames": frames}))
    return cameras


SCALE_MAT = np.array([[200.0, 0, 0, -30], [0, 200, 0, 10], [0, 0, 200, 640], [0, 0, 0, 1]])


def small_dtu(
    root: Path, *, count: int = 5, digits: int = 3, images: str = "image", archive: str = "cameras_sphere.npz"
) -> Any:
    """Write world_mat and scale_mat of a ring, with pixel centres at integers as in DTU."""
    cameras = ring(count)
    arrays = {}
    for index, camera in enumerate(cameras):
        K = camera.K
        K[:2, 2] -= 0.5
        P = np.eye(4)
        P[:3] = K @ camera.T_cam_world[:3] @ np.linalg.inv(SCALE_MAT)
        arrays[f"world_mat_{index}"] = (P * (-3.0 if index == 1 else 1.0)).astype(np.float64)
        arrays[f"scale_mat_{index}"] = SCALE_MAT
        arrays[f"world_mat_inv_{index}"] = np.linalg.inv(P)
        write_image_of(root / images / f"{index:06d}.png", seed=index)
        mask = np.zeros((30, 40), np.uint8)
        mask[10:20, 5 : 20 + index] = 255
        (root / "mask").mkdir(exist_ok=True)
        Image.fromarray(np.stack([mask] * 3, axis=2)).save(root / "mask" / f"{index:0{digits}d}.png")
    np.savez(root / archive, **arrays)
    return cameras


def tree_hash(root: Path) -> dict[str, str]:
    """Return names, contents and modification times of all files and folders below ``root``."""
    out = {}
    for path in sorted(root.rglob("*")):
        content = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        out[path.relative_to(root).as_posix()] = f"{content} {path.stat().st_mtime_ns}"
    return out
