"""Captures of Meshroom (AliceVision): scene as JSON (``cameras.sfm``, ``sfm.json``) and images.

Conventions (AliceVision's sfmDataIO and camera modules, and its own export to COLMAP): ``rotation`` is the world-to-
camera matrix column by column, ``center`` the camera centre; x right, y down, z forward. Views of a rig share a pose;
the sub-poses of the rig are relative to it. The meaning of numbers depends on the file version: the principal point is
relative to the image centre since 1.2.1, before to the corner; the focal length is in millimetres of a sensor of
``sensorWidth`` since 1.2.2, before in pixels; ``pixelRatio`` is fy / fx since 1.2.5, before fx / fy. Numbers are text.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.contrib.capture.camera_files import (
    FileReader,
    entries,
    files_ending,
    points_beside,
    pose_from_camera_to_world,
    real,
    reals,
    register_file_reader,
    required,
    whole,
)
from gs2d.core.json_files import read_json
from gs2d.data.build import Capture, PosedImage, skipping
from gs2d.data.camera_models import Lens
from gs2d.data.file_names import find_photographs, head, in_any_case
from gs2d.data.scene import PointCloud
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError

#: distortion -> (kind of lens, number of parameters); in older files it is part of the type name
_LENSES: Mapping[str, tuple[str, int]] = {
    "none": ("perspective", 0),
    "radialk1": ("perspective", 1),
    "radialk3": ("perspective", 3),
    "brown": ("perspective", 5),
    "fisheye4": ("fisheye", 4),
    "fisheye1": ("fov", 1),
}
_OLD_TYPES = {"pinhole": "none", "radial1": "radialk1", "radial3": "radialk3"} | {
    name: name for name in ("brown", "fisheye4", "fisheye1")
}
_FILES = ("cameras.sfm", "sfm.json", "cameras.json")


def scene_file(root: Path) -> Path | None:
    """Return the scene file of AliceVision in a folder, ``cameras.sfm`` first; None without one."""
    files = [in_any_case(root, name) for name in _FILES] + files_ending(root, ".sfm")
    return next((path for path in files if _is_scene(path)), None)


def _is_scene(path: Path) -> bool:
    begins = head(path)
    return b'"version"' in begins and any(
        word in begins for word in (b'"views"', b'"featuresFolders"', b'"intrinsics"')
    )


def read_alicevision(root: Path) -> Capture:
    """Read the views with a pose, including those of rigs; other views are skipped.

    Images are at the paths in the file, else searched by name in ``images`` or elsewhere below the folder. Points are
    in the file (``structure``), else in a PLY file beside it. A DataError about an invalid file or an unsupported
    camera names the file and the entry.
    """
    path = scene_file(root)
    if path is None:
        raise DataError(f"{root} must hold cameras.sfm or sfm.json of Meshroom, got no such file")
    data = entries(read_json(path), str(path))
    version = _version(data, path)
    poses = {
        str(pose.get("poseId")): pose for pose in _list(data, "poses", path)
    }  # views share the pose of a rig or a stack of exposures
    cameras = {str(camera.get("intrinsicId")): camera for camera in _list(data, "intrinsics", path)}
    if not poses:
        raise DataError(
            f"{path} must hold poses, got none; use the file of the node StructureFromMotion (cameras.sfm), or of "
            "ConvertSfMFormat with SfM File Format json"
        )
    frames: list[PosedImage] = []
    skipped: list[str] = []
    rigs = {str(rig.get("rigId")): _list(rig, "subPoses", path) for rig in _list(data, "rigs", path)}
    placed = []
    views = _list(data, "views", path)
    shared = Counter(_pose_id(view) for view in views)
    for index, view in enumerate(views):
        written = str(required(view, "path", f"{path}: view {index}"))
        in_rig = "rigId" in view and not _is_independent(view, shared[_pose_id(view)])
        with skipping(_label(written), skipped):
            T = _pose(view, poses, rigs if in_rig else None, f"{path}: view {written}")
            if isinstance(T, str):
                skipped.append(f"{_label(written)}: {T}")
            else:
                placed.append((view, written, T))
    photographs = find_photographs([written for _, written, _ in placed], [in_any_case(root, "images"), root], path)
    for view, written, T in placed:
        photo = photographs[written]
        if photo.path is None:
            skipped.append(f"{_label(written)}: {photo.reason}")
            continue
        key = str(view.get("intrinsicId"))
        if key not in cameras:
            raise DataError(f"{path}: intrinsics must hold {key} of view {_label(written)}, got {sorted(cameras)[:9]}")
        with skipping(_label(written), skipped):
            k = _intrinsics(cameras[key], version, f"{path}: intrinsic {key}")
            frames.append(PosedImage(photo.name, photo.path, k, T))
    points, notes = _points(data, path), list[str]()
    if points is None:
        points, notes = points_beside(root, frames)
    return Capture("alicevision", tuple(frames), points, skipped=tuple(skipped), notes=tuple(notes))


register_file_reader("alicevision", FileReader("cameras.sfm (Meshroom)", scene_file, read_alicevision), __name__)


def _version(data: Mapping[str, Any], path: Path) -> tuple[int, ...]:
    value = required(data, "version", str(path))
    if not isinstance(value, list) or len(value) != 3:
        raise DataError(f"{path}: version must be 3 numbers, got {json.dumps(value)[:40]}")
    return tuple(whole(part, f"{path}: version") for part in value)


def _list(data: Mapping[str, Any], key: str, path: Path) -> Sequence[Mapping[str, Any]]:
    """Return a list of objects; an empty list may be written as empty text."""
    value = data.get(key) or []
    if not isinstance(value, list):
        raise DataError(f"{path}: {key} must be a list, got {type(value).__name__}")
    return [entries(item, f"{path}: {key} {index}") for index, item in enumerate(value)]


def _label(written: str) -> str:
    return written.replace("\\", "/").rsplit("/", 1)[-1]


def _pose_id(view: Mapping[str, Any]) -> str:
    return str(view.get("poseId", view.get("viewId")))


def _is_independent(view: Mapping[str, Any], views_of_pose: int) -> bool:
    """Return whether a view in a rig has its own pose; by default, if no other view shares the pose."""
    return str(view.get("isPoseIndependant", views_of_pose < 2)).lower() in ("true", "1")  # Meshroom's spelling


def _pose(
    view: Mapping[str, Any],
    poses: Mapping[str, Mapping[str, Any]],
    rigs: Mapping[str, Sequence[Mapping[str, Any]]] | None,
    where: str,
) -> np.ndarray | str:
    """Return T_cam_world [4, 4] of a view, or the reason why it has none; ``rigs`` for views in a rig."""
    key = _pose_id(view)
    if key not in poses:
        return "not placed by Meshroom"
    inner = entries(required(poses[key], "pose", where), f"{where}: pose")
    T = _rigid(entries(required(inner, "transform", where), f"{where}: transform"), where)
    if rigs is None:
        return T
    mounted, index = rigs.get(str(view["rigId"]), ()), whole(view.get("subPoseId", 0), f"{where}: subPoseId")
    if index >= len(mounted) or mounted[index].get("status") == "uninitialized":
        return "its camera has no pose in the rig"
    inner = entries(required(mounted[index], "pose", where), f"{where}: pose in the rig")
    return np.asarray(_rigid(inner, f"{where}: pose in the rig") @ T)


def _rigid(transform: Mapping[str, Any], where: str) -> np.ndarray:
    """Return T_cam_world [4, 4] of a rotation and a centre."""
    # Stored column by column: reading rows gives the camera-to-world rotation.
    columns = reals(required(transform, "rotation", where), 9, f"{where}: rotation").reshape(3, 3)
    center = reals(required(transform, "center", where), 3, f"{where}: center")
    return pose_from_camera_to_world(np.column_stack([columns, center]), f"{where}: transform", opengl=False)


def _intrinsics(camera: Mapping[str, Any], version: tuple[int, ...], where: str) -> Intrinsics:
    kind = str(required(camera, "type", where))
    model = str(camera.get("distortionType", "none")) if kind == "pinhole" else _OLD_TYPES.get(kind, kind)
    undistortion = str(camera.get("undistortionType", "none"))
    if model not in _LENSES or undistortion != "none":
        raise DataError(
            f"{where} is of type {kind} with distortion {model} and undistortion {undistortion}, which is not "
            f"supported (supported: {', '.join(_LENSES)}); use the folder of Meshroom's node PrepareDenseScene or "
            "ExportColmap"
        )
    width, height = (whole(required(camera, side, where), f"{where}: {side}") for side in ("width", "height"))
    fx, fy = _focal(camera, version, width, where)
    if not (min(fx, fy) > 0 and min(width, height) > 0):
        raise DataError(f"{where} must have a positive size and focal length, got {width}x{height}, {fx:g}, {fy:g}")
    center = reals(required(camera, "principalPoint", where), 2, f"{where}: principalPoint")
    if version >= (1, 2, 1):
        center = center + np.array((width, height)) / 2
    shape, count = _LENSES[model]
    written = camera.get("distortionParams") or []
    lens = None
    if count and written:  # without parameters, the lens was not estimated
        value = tuple(reals(written, count, f"{where}: distortionParams").tolist())
        lens = Lens(shape, value[:3], (), (value[3], value[4])) if model == "brown" else Lens(shape, value)
    return Intrinsics(
        width, height, fx, fy, float(center[0]), float(center[1]), None if lens is None or lens.is_identity else lens
    )


def _focal(camera: Mapping[str, Any], version: tuple[int, ...], width: int, where: str) -> tuple[float, float]:
    """Return fx, fy in pixels."""
    if version < (1, 2, 0):
        f = real(required(camera, "pxFocalLength", where), f"{where}: pxFocalLength")
        return f, f
    if version < (1, 2, 2):
        both = reals(required(camera, "pxFocalLength", where), 2, f"{where}: pxFocalLength")
        return float(both[0]), float(both[1])
    sensor = real(camera.get("sensorWidth", 36.0), f"{where}: sensorWidth")
    ratio = real(camera.get("pixelRatio", 1.0), f"{where}: pixelRatio")
    if not (sensor > 0 and ratio > 0):
        raise DataError(f"{where} must have a positive sensorWidth and pixelRatio, got {sensor:g}, {ratio:g}")
    fx = real(required(camera, "focalLength", where), f"{where}: focalLength") / sensor * width
    return fx, fx / ratio if version < (1, 2, 5) else fx * ratio


def _points(data: Mapping[str, Any], path: Path) -> PointCloud | None:
    landmarks = _list(data, "structure", path)
    if not landmarks:
        return None
    try:
        points = np.array([row["X"] for row in landmarks], dtype=np.float64)
        colors = np.array([row.get("color", (128, 128, 128)) for row in landmarks], dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: structure must have X and color, 3 numbers each, got another entry") from error
    if points.shape != (len(landmarks), 3) or colors.shape != points.shape:
        raise DataError(f"{path}: structure must have X and color, 3 numbers each, got {list(points.shape)}")
    return PointCloud(points, np.clip(np.rint(np.nan_to_num(colors)), 0, 255).astype(np.uint8))
