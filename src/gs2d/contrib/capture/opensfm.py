"""Captures of OpenSfM, OpenDroneMap and WebODM: ``reconstruction.json`` and images.

Conventions (OpenSfM's documentation, "Geometric Models" and "Dataset Structure"): rotation (axis times angle) and
translation map world to camera coordinates; x right, y down, z forward. Normalised image coordinates have their origin
in the image centre and the larger side as unit. Pixel centres of OpenSfM are integers, so that the image centre is
((w - 1) / 2, (h - 1) / 2) there and (w / 2, h / 2) here.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gs2d.contrib.capture.camera_files import FileReader, entries, real, reals, register_file_reader, required, whole
from gs2d.core.json_files import read_json
from gs2d.data.build import Capture, PosedImage, skipping
from gs2d.data.camera_models import Lens
from gs2d.data.faces import panorama
from gs2d.data.file_names import find_photographs, in_any_case
from gs2d.data.image_files import image_size
from gs2d.data.scene import PointCloud
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError

#: OpenSfM's projection type -> (kind of lens, radial coefficients, has c_x and c_y, has p1 and p2)
_MODELS: Mapping[str, tuple[str, int, bool, bool]] = {
    "perspective": ("perspective", 2, False, False),
    "simple_radial": ("perspective", 1, True, False),
    "radial": ("perspective", 2, True, False),
    "brown": ("perspective", 3, True, True),
    "fisheye": ("fisheye", 2, False, False),
    "fisheye_opencv": ("fisheye", 4, True, False),
    "fisheye62": ("fisheye", 6, True, True),
}
_PANORAMAS = ("spherical", "equirectangular")
FILES = ("reconstruction.json", "opensfm/reconstruction.json")


def reconstruction_file(root: Path) -> Path | None:
    """Return the reconstruction of an OpenSfM data set or an OpenDroneMap project; None without one."""
    return next((path for name in FILES if (path := in_any_case(root, name)).is_file()), None)


def read_opensfm(root: Path) -> Capture:
    """Read the largest reconstruction in ``reconstruction.json``; a DataError names the file and the entry.

    Images are in ``images`` (OpenDroneMap: beside the folder ``opensfm``).
    """
    path = reconstruction_file(root)
    if path is None:
        raise DataError(f"{root} must hold {' or '.join(FILES)} (OpenSfM), got neither")
    reconstruction, notes = _largest(path)
    homes = dict.fromkeys((path.parent, root, root.parent if root.name == "opensfm" else root))
    cameras = entries(required(reconstruction, "cameras", str(path)), f"{path}: cameras")
    shots = entries(required(reconstruction, "shots", str(path)), f"{path}: shots")
    frames: list[PosedImage] = []
    skipped: list[str] = []
    photographs = find_photographs(list(shots), [*(in_any_case(home, "images") for home in homes), root], path)
    for name, shot in shots.items():
        where = f"{path}: shot {name}"
        shot = entries(shot, where)
        photo = photographs[name]
        if photo.path is None:
            skipped.append(f"{name}: {photo.reason}")
            continue
        key = str(required(shot, "camera", where))
        if key not in cameras:
            raise DataError(f"{path}: cameras must hold {key!r} of shot {name}, got {sorted(cameras)[:9]}")
        with skipping(name, skipped):
            k = _intrinsics(entries(cameras[key], f"{path}: camera {key}"), photo.path, f"{path}: camera {key}")
            frames.append(PosedImage(photo.name, photo.path, k, _pose(shot, where)))
    points = _points(reconstruction.get("points"), path)
    return Capture(
        "opensfm", tuple(frames), points, skipped=tuple(skipped), notes=tuple(notes), mask_homes=tuple(homes)
    )


register_file_reader(
    "opensfm", FileReader("reconstruction.json (OpenSfM, OpenDroneMap)", reconstruction_file, read_opensfm), __name__
)


def _largest(path: Path) -> tuple[Mapping[str, Any], list[str]]:
    """Return the reconstruction with most shots, and a note if there are several."""
    data = read_json(path)
    if isinstance(data, dict) and "shots" in data:
        data = [data]
    if not isinstance(data, list) or not data:
        kind = "an empty list" if data == [] else type(data).__name__
        raise DataError(f"{path} must be a list of reconstructions (OpenSfM), got {kind}; did the reconstruction fail?")
    every = [entries(item, f"{path}: reconstruction {index}") for index, item in enumerate(data)]
    counts = [len(entries(item.get("shots", {}), f"{path}: shots")) for item in every]
    best = int(np.argmax(counts))
    if len(every) == 1:
        return every[0], []
    others = ", ".join(str(count) for index, count in enumerate(counts) if index != best)
    return every[best], [
        f"{path.name} holds {len(every)} separate reconstructions: using the one with {counts[best]} images, "
        f"not those with {others}"
    ]


def _pose(shot: Mapping[str, Any], where: str) -> np.ndarray:
    """Return T_cam_world [4, 4]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(reals(required(shot, "rotation", where), 3, f"{where}: rotation")).as_matrix()
    T[:3, 3] = reals(required(shot, "translation", where), 3, f"{where}: translation")
    return T


def _intrinsics(camera: Mapping[str, Any], image: Path, where: str) -> Intrinsics:
    """Convert normalised intrinsics, whose unit is the larger side, to pixels."""
    model = str(camera.get("projection_type", "perspective"))
    if model in _PANORAMAS:
        size = [whole(camera.get(side, 0), f"{where}: {side}") for side in ("width", "height")]
        width, height = size if all(size) else image_size(image)
        return panorama(width, height, where)
    if model not in _MODELS:
        raise DataError(
            f"{where} has the unsupported projection {model} (supported: {', '.join(sorted(_MODELS))}); "
            "run `opensfm undistort` and use its folder undistorted, or calibrate with another --camera-lens"
        )
    kind, radial, has_center, has_tangential = _MODELS[model]

    def number(key: str) -> float:
        return real(camera.get(key, 0.0), f"{where}: {key}")

    width, height = whole(camera.get("width", 0), f"{where}: width"), whole(camera.get("height", 0), f"{where}: height")
    if not (width and height):
        width, height = image_size(image)
    unit = max(width, height)
    one_focal = "focal" in camera and "focal_x" not in camera
    focal = [real(required(camera, "focal" if one_focal else key, where), where) for key in ("focal_x", "focal_y")]
    if min(focal) <= 0:
        raise DataError(f"{where} must have a positive focal length, got {focal[0]}, {focal[1]}")
    x, y = (number("c_x"), number("c_y")) if has_center else (0.0, 0.0)
    tangential = (number("p1"), number("p2")) if has_tangential else (0.0, 0.0)
    lens = Lens(kind, tuple(number(f"k{i + 1}") for i in range(radial)), (), tangential)
    return Intrinsics(
        width,
        height,
        focal[0] * unit,
        focal[1] * unit,
        width / 2 + x * unit,
        height / 2 + y * unit,
        None if lens.is_identity else lens,
    )


def _points(value: Any, path: Path) -> PointCloud | None:
    """Return the points of a reconstruction; non-finite ones are removed later."""
    if not value:
        return None
    rows = entries(value, f"{path}: points")
    try:
        points = np.array([row["coordinates"] for row in rows.values()], dtype=np.float64)
        colors = np.array([row.get("color", (128, 128, 128)) for row in rows.values()], dtype=np.float64)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(f"{path}: points must have 3 coordinates and a color each, got another entry") from error
    if points.shape != (len(rows), 3) or colors.shape != (len(rows), 3):
        raise DataError(f"{path}: points must have 3 coordinates and 3 colours each, got {list(points.shape)}")
    return PointCloud(points, np.clip(np.rint(np.nan_to_num(colors)), 0, 255).astype(np.uint8))
