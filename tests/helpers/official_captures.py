"""Write DTU and Tanks and Temples captures with their official files, from the seeded scenes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from gs2d.core.camera import look_at
from gs2d.io.ply_format import write_ply
from oracle_scenes import DtuScene, TntScene, dtu_scene, moved, similarity, tnt_scene

T_MM = similarity(12.0, np.eye(3), (5, -3, 0))  # one scene unit is 12 mm


def write_points(path: Path, points: np.ndarray) -> None:
    rows = np.zeros(len(points), [(c, "<f8") for c in "xyz"])
    for i in range(3):
        rows["xyz"[i]] = points[:, i]
    write_ply(path, {"vertex": rows})


def write_tnt_capture(folder: Path, name: str = "Truck") -> tuple[Path, Path, TntScene]:
    """Write ``TrainingSet/Truck`` with a text model, and ``GT/Truck``; return capture, ground truth and scene."""
    scene = tnt_scene(0)
    root, truth = folder / "TrainingSet" / name, folder / "GT" / name
    (root / "images").mkdir(parents=True)
    (root / "sparse/0").mkdir(parents=True)
    target = moved(np.linalg.inv(scene.T_truth_capture), np.zeros((1, 3)))[0]
    lines = []
    for i, center in enumerate(scene.centers):
        camera = look_at(center, target, np.array([0.1, 0.2, 1.0]), width=8, height=6, fx=7)
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *camera.T_cam_world[:3, 3]))
        lines.append(f"{i + 1} {pose} 1 {i + 1:06d}.jpg\n\n")
        Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(root / f"images/{i + 1:06d}.jpg")
    (root / "sparse/0/cameras.txt").write_text("1 PINHOLE 8 6 7 7 4 3\n")
    (root / "sparse/0/images.txt").write_text("".join(lines))
    (root / "sparse/0/points3D.txt").write_text("1 0 0 0 1 2 3 0.1\n")
    truth.mkdir(parents=True)
    write_points(truth / f"{name}.ply", scene.scan)
    (truth / f"{name}.json").write_text(json.dumps(scene.crop))
    np.savetxt(truth / f"{name}_trans.txt", scene.T_truth_log)
    write_log(truth / f"{name}_COLMAP_SfM.log", scene.log)
    own = scene.log.copy()
    own[:, :3, 3] = scene.centers
    write_log(root / f"{name}_COLMAP_SfM.log", own)
    return root, truth, scene


def write_log(path: Path, poses: np.ndarray) -> None:
    with open(path, "w") as file:
        for i, pose in enumerate(poses):
            file.write(f"{i} {i} 0\n")
            np.savetxt(file, pose)


def write_dtu_capture(folder: Path) -> tuple[Path, Path, DtuScene]:
    """Write ``DTU/scan24`` in the frame of T_MM, with full silhouettes, and ``Official`` beside it."""
    scene = dtu_scene(0)
    root, official = folder / "DTU/scan24", folder / "Official"
    (root / "image").mkdir(parents=True)
    (root / "mask").mkdir()
    arrays = {}
    for i in range(4):
        eye, up = np.array([3 * np.cos(i), 3 * np.sin(i), 4.0]), np.array([0, 0, 1.0])
        camera = look_at(eye, np.zeros(3), up, width=40, height=30, fx=40)
        P = np.eye(4)
        K = camera.K
        K[:2, 2] -= 0.5
        P[:3] = K @ camera.T_cam_world[:3] @ np.linalg.inv(T_MM)
        arrays |= {f"world_mat_{i}": P, f"scale_mat_{i}": T_MM}
        Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(root / f"image/{i:06d}.png")
        Image.fromarray(np.full((30, 40, 3), 255, np.uint8)).save(root / f"mask/{i:03d}.png")
    np.savez(root / "cameras_sphere.npz", **arrays)
    (official / "Points/stl").mkdir(parents=True)
    (official / "ObsMask").mkdir()
    write_points(official / "Points/stl/stl024_total.ply", scene.scan)
    savemat(official / "ObsMask/ObsMask24_10.mat", {"ObsMask": scene.observed, "BB": scene.bounds, "Res": 2.0})
    savemat(official / "ObsMask/Plane24.mat", {"P": scene.plane[:, None]})
    return root, official, scene
