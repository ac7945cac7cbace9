"""DTU in the layout of IDR and NeuS: photographs, masks, and one npz of projection matrices."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.linalg import rq

from gs2d.data.capture import Capture, Frame
from gs2d.data.colmap import model_points
from gs2d.data.colmap_model import find_model, read_images
from gs2d.data.lens import Intrinsics
from gs2d.data.scene import PointCloud
from gs2d.errors import DataError
from gs2d.images import image_size

CAMERA_FILES = ("cameras_sphere.npz", "cameras.npz")
_IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg"}


def read_dtu(root: Path) -> Capture:
    """Read a DTU scan.

    View i is the i-th file in sorted order. P_i = world_mat_i @ scale_mat_i maps the unit-sphere frame, which is the
    scene's frame, to pixels whose centres are whole numbers; ours are at + 0.5, so 0.5 is added to cx and cy.
    T_metric_scene = scale_mat_0 maps the scene to millimetres. Masks (``mask/NNN.png``) are silhouettes
    (``View.object_mask``), as is an alpha channel: the background is trained. All views train.
    Sparse points of ``sparse/0`` are used if its cameras stand where these do.

    Raises
    ------
    DataError
        A missing or broken file, another number of images than cameras, or matrices that are no cameras.
    """
    path = next((root / name for name in CAMERA_FILES if (root / name).is_file()), None)
    if path is None:
        raise DataError(f"{root} must hold {' or '.join(CAMERA_FILES)}, got neither")
    world, scale = _read_matrices(path)
    images = _files(root, ("image", "images"))
    if not images:
        raise DataError(f"{root} must have its photographs in the folder image or images, got none")
    indices = _view_indices(images, sorted(world), path)
    masks = _files(root, ("mask", "masks"))
    mask_of = dict(zip(_view_indices(masks, sorted(world), path), masks, strict=True)) if masks else {}
    frames, skipped = [], []
    for index, image in zip(indices, images, strict=True):
        if index not in world:
            skipped.append(f"{image.name}: {path.name} has no world_mat_{index}")
            continue
        where = f"{path}: view {index}"
        width, height = image_size(image)
        fx, fy, cx, cy, T = decompose_projection(world[index] @ scale[index], where)
        frames.append(
            Frame(
                image.name,
                image,
                Intrinsics(width, height, fx, fy, cx + 0.5, cy + 0.5),
                T,
                object_mask=mask_of.get(index),
                alpha_is_silhouette=True,
            )
        )
    missing = sorted(set(world) - set(indices))
    skipped += [f"view {index}: no photograph" for index in missing]
    points, notes = _sparse_points(root, frames)
    if masks:
        notes += (f"masks: {sum(f.object_mask is not None for f in frames)} of {len(frames)} views have a silhouette",)
    return Capture(
        "dtu",
        tuple(frames),
        points,
        T_metric_scene=scale[min(scale)],
        default_test_every=0,
        skipped=tuple(skipped),
        notes=notes,
    )


def decompose_projection(P: np.ndarray, where: str) -> tuple[float, float, float, float, np.ndarray]:
    """fx, fy, cx, cy and T_cam_world [4, 4] of a projection matrix [3 or 4, 4] of any scale.

    P[:, :3] = s K R by RQ decomposition with positive diagonal of K and det R = 1; t = K^-1 P[:, 3] / s.

    Raises
    ------
    DataError
        Not finite, singular, or with a skew that a pinhole camera does not have.
    """
    M = P[:3, :3]
    if not np.isfinite(P[:3]).all() or not abs(np.linalg.det(M)) > 1e-12 * np.abs(M).max() ** 3:
        raise DataError(
            f"{where}: world_mat @ scale_mat must be a finite camera of full rank, got {P[:3].round(4).tolist()}"
        )
    if np.linalg.det(M) < 0:
        P, M = -P, -M  # a projection matrix has no sign
    K, R = rq(M)
    signs = np.sign(np.diag(K))
    K, R = K * signs, R * signs[:, None]
    t = np.linalg.solve(K, P[:3, 3])  # K holds the scale s, so this is t itself
    K = K / K[2, 2]
    if abs(K[0, 1]) > 2e-3 * K[0, 0]:
        raise DataError(f"{where} must have no skew, got {K[0, 1]:.3g} px at a focal length of {K[0, 0]:.5g}")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), T


def _read_matrices(path: Path) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """world_mat and scale_mat [4, 4] of each view."""
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {
                key: np.asarray(file[key], dtype=np.float64)
                for key in file.files
                if key.startswith(("world_mat_", "scale_mat_")) and "inv" not in key
            }
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise DataError(f"{path} must be a numpy archive of camera matrices, got: {error}; copy it again") from error
    world: dict[int, np.ndarray] = {}
    scale: dict[int, np.ndarray] = {}
    for key, matrix in arrays.items():
        number = key.rsplit("_", 1)[1]
        if not number.isdigit() or matrix.shape != (4, 4):
            raise DataError(f"{path}: {key} must be a 4x4 matrix of view NUMBER, got shape {list(matrix.shape)}")
        (world if key.startswith("world") else scale)[int(number)] = matrix
    if not world or set(world) != set(scale):
        raise DataError(
            f"{path} must hold world_mat_i and scale_mat_i of every view, got {len(world)} and {len(scale)} of them"
        )
    first = scale[min(scale)]
    if not np.isfinite(first).all() or not all(np.allclose(matrix, first) for matrix in scale.values()):
        raise DataError(f"{path}: all scale_mat_i must be the same finite matrix, got different ones")
    return world, scale


def _files(root: Path, names: Sequence[str]) -> list[Path]:
    for name in names:
        if (root / name).is_dir():
            return sorted(p for p in (root / name).iterdir() if p.suffix.lower() in _IMAGE_SUFFIXES)
    return []


def _view_indices(files: list[Path], views: list[int], path: Path) -> list[int]:
    """Index of the view of each file: its position if there are as many as cameras, else the number in its name."""
    if len(files) == len(views):
        return views
    if all(file.stem.isdigit() for file in files):
        return [int(file.stem) for file in files]
    raise DataError(
        f"{files[0].parent} must hold as many images as {path.name} has views, {len(views)}, or be numbered; "
        f"got {len(files)}"
    )


def _sparse_points(root: Path, frames: list[Frame]) -> tuple[PointCloud | None, tuple[str, ...]]:
    """The points of ``sparse/0``, if its cameras stand where the frames' do."""
    folder = root / "sparse" / "0"
    kind = find_model(folder)
    points = model_points(folder, kind) if kind is not None else None
    if kind is None or points is None:
        return None, ()

    def center(T: np.ndarray) -> np.ndarray:
        return np.asarray(-T[:3, :3].T @ T[:3, 3])

    ours = {Path(frame.name).stem: center(frame.T_cam_world) for frame in frames}
    theirs = {Path(image.name).stem: center(image.T_cam_world) for image in read_images(folder, kind)}
    common = sorted(set(ours) & set(theirs))
    if common:
        a, b = np.stack([ours[name] for name in common]), np.stack([theirs[name] for name in common])
        spread = max(float(np.linalg.norm(a - a.mean(axis=0), axis=1).max()), 1e-12)
        if np.linalg.norm(a - b, axis=1).max() < 0.02 * spread:
            return points, ()
    return None, ("the points of sparse/0 are in another frame than the cameras and are not used",)
