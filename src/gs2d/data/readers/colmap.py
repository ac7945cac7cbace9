"""A folder with photographs and a COLMAP model."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from gs2d.core.images import image_size
from gs2d.data.build import Capture, PosedImage
from gs2d.data.priors import ObservedPoints
from gs2d.data.readers.colmap_model import ColmapCamera, ColmapImage, find_model, read_cameras, read_images, read_points
from gs2d.data.scene import PointCloud
from gs2d.data.undistort import Intrinsics, colmap_intrinsics
from gs2d.errors import DataError

MODEL_FOLDERS = ("sparse/0", "sparse", ".")


def model_folder(root: Path) -> tuple[Path, str] | None:
    """Find the model's folder and kind ("bin" or "txt"), or None: ``sparse/0``, ``sparse`` or ``root`` itself."""
    for name in MODEL_FOLDERS:
        kind = find_model(root / name)
        if kind is not None:
            return root / name, kind
    return None


def read_colmap(root: Path, downscale: int) -> Capture:
    """Read a COLMAP data set.

    Photographs are in ``images`` beside ``sparse`` (also in sub-folders of it), or in ``images_N`` when ``downscale``
    is N and that folder exists. Masks are in ``masks``, one for an image ``a/b.jpg`` named ``a/b.jpg.png`` (as COLMAP
    does) or ``a/b.png``; white = keep. EXIF orientation is ignored, as COLMAP ignores it.

    Raises
    ------
    DataError
        No model, a broken one, a camera model that cannot be undistorted, no folder of images.
    """
    found = model_folder(root)
    if found is None:
        raise DataError(
            f"{root} must hold a COLMAP model: cameras.bin and images.bin (or .txt) in sparse/0, sparse or itself"
        )
    folder, kind = found
    cameras = read_cameras(folder, kind)
    images = read_images(folder, kind)
    home, image_folder = _image_folder(root, folder, images)
    notes: list[str] = _other_models(folder)
    scaled = home / f"images_{downscale}"
    factor = 1
    if downscale > 1 and scaled.is_dir():
        if any((scaled / image.name).is_file() for image in images):
            image_folder, factor = scaled, downscale
            notes.append(f"photographs of 1/{downscale} size are read from {scaled.name}")
        else:
            notes.append(f"{scaled.name} holds none of the model's photographs and is not used")
    frames, skipped = [], []
    intrinsics: dict[int, Intrinsics] = {}
    for image in images:
        name = image.name.replace("\\", "/")
        path = image_folder / name
        if not path.is_file():
            skipped.append(f"{name}: no such file in {image_folder.name}")
            continue
        if image.camera_id not in intrinsics:
            intrinsics[image.camera_id] = _intrinsics(folder / f"cameras.{kind}", cameras, image)
        k = intrinsics[image.camera_id]
        if factor > 1:
            _check_factor(path, k, factor)
        mask = find_mask(home / "masks", name)
        frames.append(PosedImage(name, path, k, image.T_cam_world, mask=mask))
    masked = sum(frame.mask is not None for frame in frames)
    if (home / "masks").is_dir():
        notes.append(f"masks: {masked} of {len(frames)} views have one in {(home / 'masks').name} (white = keep)")
    return Capture(
        "colmap",
        tuple(frames),
        points=model_points(folder, kind),
        downscaled_by=factor,
        skipped=tuple(skipped),
        notes=tuple(notes),
        home=home,
        observe=partial(observed_points, folder, kind),
    )


def observed_points(folder: Path, kind: str) -> ObservedPoints:
    """Which points of a model each of its images was found to show.

    Raises
    ------
    DataError
        The model has no points, or a file is broken.
    """
    points = read_points(folder, kind)
    if points is None or not len(points.ids):
        raise DataError(f"{folder} must hold sparse points in points3D.{kind}, got none")
    order = np.argsort(points.ids)
    track = np.zeros(len(order), dtype=np.int64)
    seen = {}
    for image in read_images(folder, kind, observations=True):
        assert image.point_ids is not None
        ids = np.unique(image.point_ids[image.point_ids >= 0])
        at = order[np.searchsorted(points.ids, ids, sorter=order).clip(max=len(order) - 1)]
        rows = at[points.ids[at] == ids]
        seen[image.name.replace("\\", "/")] = rows
        track[rows] += 1
    return ObservedPoints(points.xyz, points.error, track, seen)


def model_points(folder: Path, kind: str) -> PointCloud | None:
    """Return the sparse points of a model as a PointCloud, or None."""
    points = read_points(folder, kind)
    return None if points is None or not len(points.xyz) else PointCloud(points.xyz, points.rgb)


def find_mask(folder: Path, name: str) -> Path | None:
    """Return the mask of the image ``name`` in ``folder``: ``name.png``, ``name`` with the suffix .png, or ``name``."""
    candidates = (folder / f"{name}.png", (folder / name).with_suffix(".png"), folder / name)
    return next((path for path in candidates if path.is_file()), None)


def _intrinsics(path: Path, cameras: dict[int, ColmapCamera], image: ColmapImage) -> Intrinsics:
    camera = cameras.get(image.camera_id)
    if camera is None:
        raise DataError(f"{path} must hold camera {image.camera_id} of image {image.name}, got {sorted(cameras)[:9]}")
    return colmap_intrinsics(
        f"{path}: camera {image.camera_id}", camera.model, camera.width, camera.height, camera.params
    )


def _image_folder(root: Path, model: Path, images: list[ColmapImage]) -> tuple[Path, Path]:
    """Return (the folder that holds images, masks and sparse; the folder of the images)."""
    homes = dict.fromkeys([root, model.parent, model.parent.parent])
    for home in homes:
        if (home / "images").is_dir():
            return home, home / "images"
    for home in homes:
        if any((home / image.name).is_file() for image in images):
            return home, home
    raise DataError(f"{root} must have its photographs in the folder images, got no such folder")


def _other_models(folder: Path) -> list[str]:
    if folder.name != "0":
        return []
    others = sorted(p.name for p in folder.parent.iterdir() if p != folder and p.is_dir() and find_model(p))
    return [f"only the model sparse/0 is read; others are there: {', '.join(others)}"] if others else []


def _check_factor(path: Path, k: Intrinsics, factor: int) -> None:
    """Check that a file in ``images_N`` is 1/N of its camera's size, up to rounding."""
    got, expected = np.array(image_size(path)), np.array((k.width, k.height)) / factor
    if (np.abs(got - expected) > np.maximum(1.0, 0.01 * expected)).any():
        raise DataError(
            f"{path} must be 1/{factor} of its camera's {k.width}x{k.height}, got {got[0]}x{got[1]}; "
            f"remove or rebuild the folder {path.parent.name}"
        )
