"""Captures described by JSON: Blender (NeRF-Synthetic), nerfstudio and instant-ngp."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.contrib.capture.camera_files import FileReader, pose_from_camera_to_world, register_file_reader
from gs2d.core.json_files import read_json
from gs2d.data.build import Capture, PosedImage, skipping
from gs2d.data.camera_models import CAMERA_MODELS, Lens
from gs2d.data.faces import panorama
from gs2d.data.file_names import Files, ImageFile, find_photographs, in_any_case
from gs2d.data.image_files import image_size
from gs2d.data.masks import FOLDER
from gs2d.data.prior_maps import DEPTHS, NORMALS, MapFiles
from gs2d.data.scene import PointCloud
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError, UnusableViewError
from gs2d.io.meshes import read_points

TRAIN, TEST = "transforms_train.json", "transforms_test.json"  # Blender
CAMERAS = "transforms.json"  # nerfstudio and instant-ngp
_LARGEST = 1e300  # JSON integers are unbounded
_PERSPECTIVE = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"}
_FISHEYE = {"OPENCV_FISHEYE", "FISHEYE"}
_PANORAMA = "EQUIRECTANGULAR"
_NAMED = {"mask_path": FOLDER, "depth_file_path": DEPTHS, "normal_file_path": NORMALS}  # keys and usual folders
_WHAT = {"mask_path": "mask", "depth_file_path": "depth map", "normal_file_path": "normal map"}


def read_blender(root: Path) -> Capture:
    """Read ``transforms_train.json`` and ``transforms_test.json``; ``transforms_val.json`` is not used.

    Without ``transforms_test.json`` the frames have no split. Poses are camera-to-world with OpenGL axes. A DataError
    about an invalid or incomplete file names the file, the frame and the key.
    """
    train, test = (in_any_case(root, name) for name in (TRAIN, TEST))
    if test.is_file():
        entries = [*_entries(train, _read_meta(train), "train"), *_entries(test, _read_meta(test), "test")]
    else:
        entries = _entries(train, _read_meta(train), None)
    frames, skipped, notes = _read_frames(entries, train)
    return Capture("blender", tuple(frames), skipped=tuple(skipped), notes=tuple(notes), is_synthetic=True)


def read_nerfstudio(root: Path) -> Capture:
    """Read ``transforms.json`` of nerfstudio or instant-ngp; raises as ``read_blender`` does.

    Intrinsics and distortion are shared or per frame. Frames without a file are skipped and reported.
    ``train_filenames`` and ``test_filenames`` (else ``val_filenames``) are the split, ``ply_file_path`` the sparse
    points. Coordinates are those of the file; ``applied_transform`` and ``scale`` are already applied to them.
    """
    path = in_any_case(root, CAMERAS)
    meta = _read_meta(path)
    frames, skipped, notes = _read_frames(_entries(path, meta, None), path)
    frames, unlisted = _named_split(path, meta, frames)
    if "applied_transform" in meta:
        notes.append("poses and results are in the coordinates of the file, which has an applied_transform")
    points = None
    if meta.get("ply_file_path") is not None:
        name = _relative(meta["ply_file_path"], f"{path}: ply_file_path")
        ply = Files([root]).match([[name]])[0].path
        if ply is not None:
            cloud = read_points(ply)
            points = PointCloud(np.asarray(cloud.points, dtype=np.float64), cloud.colors)
        else:
            notes.append(f"ply_file_path {meta['ply_file_path']} does not exist: the scene has no sparse points")
    return Capture("nerfstudio", tuple(frames), points, skipped=tuple(skipped + unlisted), notes=tuple(notes))


def _finder(name: str) -> Callable[[Path], Path | None]:
    """Return a function that finds the file with a name in a folder."""

    def find(folder: Path) -> Path | None:
        file = in_any_case(folder, name)
        return file if file.is_file() else None

    return find


_BLENDER = FileReader(f"{TRAIN} (Blender)", _finder(TRAIN), read_blender, before_colmap=True, protocol="nerf-synthetic")
_NERFSTUDIO = FileReader(f"{CAMERAS} (nerfstudio)", _finder(CAMERAS), read_nerfstudio, before_colmap=True)
register_file_reader("blender", _BLENDER, __name__)
register_file_reader("nerfstudio", _NERFSTUDIO, __name__)


def _read_meta(path: Path) -> dict[str, Any]:
    meta = read_json(path)
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list):
        actual = f"the keys {sorted(meta)[:12]}" if isinstance(meta, dict) else type(meta).__name__
        raise DataError(f'{path} must be an object with a list "frames", got {actual}')
    return meta


@dataclass(frozen=True)
class _Entry:
    """A frame of a file; ``both`` includes the values shared by all frames."""

    where: str
    name: str
    frame: Mapping[str, Any]
    both: Mapping[str, Any]
    split: str | None


def _read_frames(entries: Sequence[_Entry], path: Path) -> tuple[list[PosedImage], list[str], list[str]]:
    """Return the frames whose file exists, reasons for skipped ones, and notes."""
    root = path.parent
    photographs = _photographs([entry.name for entry in entries], path)
    used = {photo.path for photo in photographs.values() if photo.path is not None}
    files = Files([root])
    masks, depths, normals = (_named(entries, key, files, used) for key in _NAMED)
    frames: list[PosedImage] = []
    skipped: list[str] = []
    lost: Counter[str] = Counter()
    for index, entry in enumerate(entries):
        photo = photographs[entry.name]
        if photo.path is None:
            skipped.append(f"{entry.name}: {photo.reason}")
            continue
        for key, paths in zip(_NAMED, (masks, depths, normals), strict=True):
            lost[_WHAT[key]] += entry.frame.get(key) is not None and paths[index] is None
        maps, where = _maps_of(entry, depths[index], normals[index]), f"{entry.where} ({entry.name})"
        with skipping(entry.name, skipped):
            matrix = _required(entry.frame, "transform_matrix", entry.where)
            pose = pose_from_camera_to_world(matrix, f"{where}: transform_matrix", opengl=True)
            k = frame_intrinsics(entry.both, photo.path, where)
            frames.append(PosedImage(photo.name, photo.path, k, pose, entry.split, mask=masks[index], maps=maps))
    notes = [f"{count} {what}s named in {path.name} do not exist" for what, count in lost.items() if count]
    return frames, skipped, notes


def _photographs(names: Sequence[str], path: Path) -> dict[str, ImageFile]:
    root = path.parent
    return find_photographs(names, [in_any_case(root, "images"), root], path, base=root, homes=[root])


def _entries(path: Path, meta: Mapping[str, Any], split: str | None) -> list[_Entry]:
    entries = []
    for index, frame in enumerate(meta["frames"]):
        where = f"{path} frame {index}"
        if not isinstance(frame, dict):
            raise DataError(f"{where} must be an object, got {type(frame).__name__}")
        name = _relative(_required(frame, "file_path", where), f"{where}: file_path")
        entries.append(_Entry(where, name, frame, {**meta, **frame}, split))
    return entries


def _named(entries: Sequence[_Entry], key: str, files: Files, used: Collection[Path]) -> list[Path | None]:
    """Return the mask or map file of each frame; None if it names none or the file does not exist."""
    names = [
        None if entry.frame.get(key) is None else _relative(entry.frame[key], f"{entry.where}: {key}")
        for entry in entries
    ]
    others = set(_NAMED.values()) - {_NAMED[key]}
    matches = iter(files.match([[name] for name in names if name is not None], not_in=others, used=used))
    return [None if name is None else next(matches).path for name in names]


def _maps_of(entry: _Entry, depth: Path | None, normal: Path | None) -> MapFiles | None:
    unit = entry.both.get("depth_unit_scale_factor")
    if unit is not None and (isinstance(unit, bool) or not isinstance(unit, int | float) or not 0 < unit < _LARGEST):
        raise DataError(f"{entry.where}: depth_unit_scale_factor must be a positive number, got {str(unit)[:40]!r}")
    return MapFiles(depth, normal, unit, metric=depth is not None) if depth or normal else None


def _required(entry: Mapping[str, Any], key: str, where: str) -> Any:
    if key not in entry:
        raise DataError(f'{where} must have the key "{key}", got {sorted(entry)[:12]}')
    return entry[key]


def _relative(value: Any, where: str) -> str:
    """Return a path of the file with ``/`` and without a leading ``./``."""
    if not isinstance(value, str) or not value:
        raise DataError(f"{where} must be a path, got {value!r}")
    return Path(value.replace("\\", "/")).as_posix()


def frame_intrinsics(entry: Mapping[str, Any], image: Path, where: str) -> Intrinsics:
    """Return the intrinsics of a frame, from its own keys or the shared ones.

    ``fl_x``, ``fl_y`` in pixels take precedence over the fields of view ``camera_angle_x``, ``camera_angle_y``: f = 0.5
    W / tan(0.5 angle). Without ``w``, ``h`` the size is that of the image file. Raises DataError if the focal length is
    missing, a value is not a number, or the camera model is not supported.
    """

    def number(key: str) -> float | None:
        value = entry.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST:
            kind = UnusableViewError if isinstance(value, float) and not math.isfinite(value) else DataError
            raise kind(f"{where}: {key} must be a finite number, got {str(value)[:40]!r}")
        return float(value)

    w, h = number("w"), number("h")
    width, height = (round(w), round(h)) if w and h else image_size(image)
    if _model(entry) == _PANORAMA:
        return panorama(width, height, where)
    fl_x, fl_y = number("fl_x"), number("fl_y")
    fx = fl_x if fl_x is not None else _focal(number("camera_angle_x"), width, f"{where}: camera_angle_x")
    fy = fl_y
    if fy is None and fl_x is None:  # with fl_x, pixels are assumed to be square
        fy = _focal(number("camera_angle_y"), height, f"{where}: camera_angle_y")
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    if fx is None or fy is None:
        raise DataError(f'{where} must have a focal length, "fl_x" or "camera_angle_x", got {sorted(entry)[:16]}')
    cx, cy = number("cx"), number("cy")
    if width < 1 or height < 1 or fx <= 0 or fy <= 0:
        raise DataError(f"{where} must have a positive size and focal length, got {width}x{height}, {fx}, {fy}")
    return Intrinsics(
        width,
        height,
        fx,
        fy,
        width / 2 if cx is None else cx,
        height / 2 if cy is None else cy,
        _lens(entry, number, where),
    )


def _focal(angle: float | None, size: int, where: str) -> float | None:
    """Return the focal length in pixels for a full field of view in radians."""
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise DataError(f"{where} must be between 0 and pi, got {angle}")
    return 0.5 * size / math.tan(0.5 * angle)


def _model(entry: Mapping[str, Any]) -> str:
    return str(entry.get("camera_model", "OPENCV_FISHEYE" if entry.get("is_fisheye") else "OPENCV")).upper()


def _lens(entry: Mapping[str, Any], number: Callable[[str], float | None], where: str) -> Lens | None:
    model, name = _model(entry), str(entry.get("camera_model"))
    if name in CAMERA_MODELS and model not in _PERSPECTIVE | _FISHEYE:
        keys = CAMERA_MODELS.get(name)().parameters
        return Lens(name, tuple(number(key) or 0.0 for key in keys))
    if model not in _PERSPECTIVE | _FISHEYE:
        raise DataError(
            f"{where}: camera_model {model} is not supported "
            f"(supported: {', '.join(sorted(_PERSPECTIVE | _FISHEYE | {_PANORAMA}))}); undistort the images first, or "
            "register it with gs2d.register_camera_model"
        )
    value = {key: number(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
    if "PINHOLE" in model and any(value.values()):
        bent = {key: number for key, number in value.items() if number}
        raise DataError(f"{where}: camera_model {model} must have no distortion, got {bent}; is it OPENCV?")
    radial = tuple(value[f"k{i}"] for i in (1, 2, 3, 4))
    lens = Lens("fisheye", radial) if model in _FISHEYE else Lens("perspective", radial, (), (value["p1"], value["p2"]))
    return None if lens.is_identity or "PINHOLE" in model else lens


def _named_split(path: Path, meta: dict[str, Any], frames: list[PosedImage]) -> tuple[list[PosedImage], list[str]]:
    """Return the frames with the split of the file, and a sentence on each frame in none of its lists."""
    written: dict[str, list[str]] = {}
    for key in ("train", "val", "test"):
        names = meta.get(f"{key}_filenames")
        if names is None:
            continue
        if not isinstance(names, list):
            raise DataError(f"{path}: {key}_filenames must be a list of paths, got {type(names).__name__}")
        written[key] = [_relative(name, f"{path}: {key}_filenames") for name in names]
    photographs = _photographs([name for names in written.values() for name in names], path)
    lists = {key: {photographs[name].name for name in names} for key, names in written.items()}
    if "train" not in lists:
        return frames, []
    test = lists.get("test") or lists.get("val") or set()
    split, unlisted = [], []
    for frame in frames:
        if frame.name in lists["train"]:
            split.append(replace(frame, split="train"))
        elif frame.name in test:
            split.append(replace(frame, split="test"))
        else:
            unlisted.append(f"{frame.name}: in none of the used lists of {path.name}")
    return split, unlisted
