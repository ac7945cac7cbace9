"""DTU in the layout of IDR and NeuS: images, masks, and a .npz file of projection matrices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.linalg import rq

from gs2d.contrib.lab.dataset_folders import CAMERA_FILES
from gs2d.core.camera import Camera
from gs2d.core.image_arrays import is_number, natural_key
from gs2d.data.arrays import read_npz
from gs2d.data.build import Capture, PosedImage
from gs2d.data.file_names import in_any_case
from gs2d.data.image_files import image_size
from gs2d.data.prior_maps import ObservedPoints
from gs2d.data.readers.capture_readers import register_reader
from gs2d.data.readers.colmap import (
    ColmapCamera,
    ColmapImage,
    find_model,
    model_points,
    observed_points,
    read_cameras,
    read_images,
)
from gs2d.data.scene import PointCloud
from gs2d.data.undistort import Intrinsics, colmap_intrinsics
from gs2d.errors import DataError

_IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg"}


def read_dtu(root: Path) -> Capture:
    """Read a DTU scan.

    View i is the i-th file in numeric order. P_i = world_mat_i @ scale_mat_i maps the unit-sphere frame, which is the
    frame of the scene, to pixels with integer centres; 0.5 is added to cx and cy. T_metric_scene = scale_mat_0 maps the
    scene to millimetres. Masks (``mask/NNN.png``) and alpha channels are silhouettes (``View.object_mask``): the
    background is trained. All views train.

    If the cameras of ``sparse/0`` have the same centres, its points are used, and its intrinsics if they match the
    image size: 2DGS undistorted its images to another size. Raises DataError if a file is missing or invalid, the
    numbers of images and cameras differ, or a matrix is not a camera.
    """
    model = _read_model(root)
    path, world, scale = _matrices_of(root, model)
    images = _files(root, ("image", "images"))
    if not images:
        raise DataError(f"{root} must have its images in the folder image or images, got none")
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
            PosedImage(
                image.name,
                image,
                Intrinsics(width, height, fx, fy, cx + 0.5, cy + 0.5),
                T,
                object_mask=mask_of.get(index),
                alpha_is_silhouette=True,
            )
        )
    missing = sorted(set(world) - set(indices))
    skipped += [f"view {index}: no image" for index in missing]
    frames, points, notes = _with_model(frames, model)
    if masks:
        notes += (f"masks: {sum(f.object_mask is not None for f in frames)} of {len(frames)} views have a silhouette",)
    return Capture(
        "dtu",
        tuple(frames),
        points,
        finds_masks=False,
        T_metric_scene=scale[min(scale)],
        default_test_every=0,
        skipped=tuple(skipped),
        notes=notes,
        observe=None if model is None or points is None else partial(_observed, model, frames),
    )


@register_reader("dtu")
class DtuReader:
    """DTU scans; those of 2DGS also contain a COLMAP model."""

    looks_for = f"{' or '.join(CAMERA_FILES)} (DTU)"
    before_colmap = True
    protocol = "dtu"

    def detect(self, path: Path) -> bool:
        """Return whether the folder has projection matrices."""
        return bool(camera_archives(path))

    def read(self, path: Path, *, downscale: int) -> Capture:
        """Read a scan."""
        return read_dtu(path)


def _observed(model: _Model, frames: Sequence[PosedImage]) -> ObservedPoints:
    """Return the observations of the model by image name of the scan, whose suffix may differ."""
    observations = observed_points(model.folder, model.kind)
    by_stem = {Path(frame.name).stem: frame.name for frame in frames}
    named = observations.by_view.items()
    by_view = {by_stem[stem]: rows for name, rows in named if (stem := Path(name).stem) in by_stem}
    return replace(observations, by_view=by_view)


def decompose_projection(P: np.ndarray, where: str) -> tuple[float, float, float, float, np.ndarray]:
    """Decompose a projection matrix [3 or 4, 4] of any scale: fx, fy, cx, cy and T_cam_world [4, 4].

    P[:, :3] = s K R by RQ decomposition with positive diagonal of K and det R = 1; t = K^-1 P[:, 3] / s. Raises
    DataError if the matrix is not finite, singular, or has skew.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # scale by a power of two, without rounding
        P = np.ldexp(P, -int(np.frexp(np.abs(P[:3, :3]).max())[1]))
    M = P[:3, :3]
    if not np.isfinite(P[:3]).all() or not abs(np.linalg.det(M)) > 1e-12 * np.abs(M).max() ** 3:
        raise DataError(
            f"{where}: world_mat @ scale_mat must be a finite camera of full rank, got {P[:3].round(4).tolist()}"
        )
    if np.linalg.det(M) < 0:
        P, M = -P, -M  # the sign of a projection matrix is arbitrary
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


@dataclass(frozen=True, eq=False)
class DtuSilhouette:
    """A mask file and its camera, at the size of the mask and in the frame of the scene."""

    camera: Camera
    path: Path


def dtu_silhouettes(root: Path) -> tuple[DtuSilhouette, ...]:
    """Return the full-size mask files of a scan with their cameras, for the culling of the official evaluation.

    Empty without mask files.
    """
    masks = _files(root, ("mask", "masks"))
    if not masks:
        return ()
    path, world, scale = _matrices_of(root, _read_model(root))
    silhouettes = []
    for index, mask in zip(_view_indices(masks, sorted(world), path), masks, strict=True):
        if index in world:
            width, height = image_size(mask)
            fx, fy, cx, cy, T = decompose_projection(world[index] @ scale[index], f"{path}: view {index}")
            silhouettes.append(DtuSilhouette(Camera(width, height, fx, fy, cx + 0.5, cy + 0.5, T), mask))
    return tuple(silhouettes)


def _matrices_of(root: Path, model: _Model | None) -> tuple[Path, dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Return the archive, its world_mat and its scale_mat; of two archives, the one in the frame of ``sparse/0``."""
    paths = camera_archives(root)
    if not paths:
        raise DataError(f"{root} must hold {' or '.join(CAMERA_FILES)}, got neither")
    if len(paths) > 1 and model is not None:
        names = [Path(name).stem for name in sorted(model.images, key=natural_key)]
        for path in paths:
            world, scale = _read_matrices(path)
            centers = {
                name: _center(decompose_projection(world[i] @ scale[i], f"{path}: view {i}")[4])
                for name, i in zip(names, sorted(world), strict=False)
            }
            if _same_places(centers, model):
                return path, world, scale
    return (paths[0], *_read_matrices(paths[0]))


def camera_archives(root: Path) -> list[Path]:
    """Return the files of projection matrices in a folder, the preferred one first."""
    return [path for name in CAMERA_FILES if (path := in_any_case(root, name)).is_file()]


def _read_matrices(path: Path) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Read world_mat and scale_mat [4, 4] of each view."""
    arrays = read_npz(
        path,
        "camera archive",
        lambda key: key.startswith(("world_mat_", "scale_mat_")) and "inv" not in key,
    )
    world: dict[int, np.ndarray] = {}
    scale: dict[int, np.ndarray] = {}
    for key, matrix in arrays.items():
        number = key.rsplit("_", 1)[1]
        if not is_number(number) or matrix.shape != (4, 4):
            raise DataError(f"{path}: {key} must be a 4x4 matrix of view NUMBER, got shape {list(matrix.shape)}")
        (world if key.startswith("world") else scale)[int(number)] = matrix.astype(np.float64)
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
        if (folder := in_any_case(root, name)).is_dir():
            files = [p for p in folder.iterdir() if p.suffix.lower() in _IMAGE_SUFFIXES]
            return sorted(files, key=lambda path: natural_key(path.name))
    return []


def _view_indices(files: list[Path], views: list[int], path: Path) -> list[int]:
    """Return the view index of each file: its position if there is one file per camera, else the number in its name."""
    if len(files) == len(views):
        return views
    if all(is_number(file.stem) for file in files):
        return [int(file.stem) for file in files]
    raise DataError(
        f"{files[0].parent} must hold one image per view of {path.name}, {len(views)}, or numbered images; "
        f"got {len(files)}"
    )


@dataclass(frozen=True, eq=False)
class _Model:
    """Content of ``sparse/0``: images by name, cameras by id, points."""

    folder: Path
    kind: str
    images: dict[str, ColmapImage]
    cameras: dict[int, ColmapCamera]
    points: PointCloud | None


def _read_model(root: Path) -> _Model | None:
    folder = in_any_case(root, "sparse/0")
    kind = find_model(folder)
    if kind is None:
        return None
    images = {image.name: image for image in read_images(folder, kind)}
    return _Model(folder, kind, images, read_cameras(folder, kind), model_points(folder, kind))


def _center(T: np.ndarray) -> np.ndarray:
    return np.asarray(-T[:3, :3].T @ T[:3, 3])


def _same_places(centers: dict[str, np.ndarray], model: _Model) -> bool:
    """Return whether the model has the same camera centres, within 2 % of their spread."""
    theirs = {Path(name).stem: _center(image.T_cam_world) for name, image in model.images.items()}
    common = sorted(set(centers) & set(theirs))
    if not common:
        return False
    a, b = np.stack([centers[name] for name in common]), np.stack([theirs[name] for name in common])
    spread = max(float(np.linalg.norm(a - a.mean(axis=0), axis=1).max()), 1e-12)
    return bool(np.linalg.norm(a - b, axis=1).max() < 0.02 * spread)


def _with_model(
    frames: list[PosedImage], model: _Model | None
) -> tuple[list[PosedImage], PointCloud | None, tuple[str, ...]]:
    """Return the frames with matching cameras of the model, its points, and notes."""
    if model is None or (model.points is None and not model.images):
        return frames, None, ()
    if not _same_places({Path(frame.name).stem: _center(frame.T_cam_world) for frame in frames}, model):
        return frames, None, ("the points of sparse/0 are in other coordinates than the cameras and are not used",)
    images = {Path(name).stem: image for name, image in model.images.items()}
    fitted = [_of_model(frame, images.get(Path(frame.name).stem), model) for frame in frames]
    changed = sum(new is not old for new, old in zip(fitted, frames, strict=True))
    notes = (
        (f"cameras of {changed} of {len(frames)} views come from sparse/0, which matches the image size",)
        if changed
        else ()
    )
    return fitted, model.points, notes


def _of_model(frame: PosedImage, image: ColmapImage | None, model: _Model) -> PosedImage:
    """Return the frame, with the camera of the model if it has the image size and other intrinsics.

    A mask of another size belongs to the original image and is then replaced by the alpha channel.
    """
    camera = None if image is None else model.cameras.get(image.camera_id)
    ours = frame.intrinsics
    if image is None or camera is None or (camera.width, camera.height) != (ours.width, ours.height):
        return frame
    where = f"{model.folder}: camera {image.camera_id}"
    theirs = colmap_intrinsics(where, camera.model, camera.width, camera.height, camera.params)
    apart = np.array([theirs.fx - ours.fx, theirs.fy - ours.fy, theirs.cx - ours.cx, theirs.cy - ours.cy])
    if np.abs(apart).max() < 0.01 * ours.width:
        return frame
    mask = frame.object_mask
    if mask is not None and image_size(mask) != (ours.width, ours.height):
        mask = None
    return replace(frame, intrinsics=theirs, T_cam_world=image.T_cam_world, object_mask=mask)
