"""Data sets described by JSON: Blender (NeRF-Synthetic), nerfstudio and instant-ngp."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.images import image_size
from gs2d.core.json_files import read_json
from gs2d.data.build import Capture, PosedImage, pose_from_camera_to_world
from gs2d.data.faces import panorama
from gs2d.data.priors import MapFiles
from gs2d.data.scene import PointCloud
from gs2d.data.undistort import Intrinsics, Lens
from gs2d.errors import DataError
from gs2d.io.meshes import read_points

_LARGEST = 1e300  # JSON has whole numbers of any size
_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")
_PERSPECTIVE = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"}
_FISHEYE = {"OPENCV_FISHEYE", "FISHEYE"}
_PANORAMA = "EQUIRECTANGULAR"


def read_blender(root: Path) -> Capture:
    """Read ``transforms_train.json`` and ``transforms_test.json``; ``transforms_val.json`` is not used.

    Without ``transforms_test.json`` the frames have no split. Poses are camera-to-world with OpenGL axes.

    Raises
    ------
    DataError
        A broken or incomplete JSON file; names the file, the frame and the key.
    """
    frames, skipped, notes = _read_frames(root / "transforms_train.json", "train")
    if (root / "transforms_test.json").is_file():
        test_frames, test_skipped, _ = _read_frames(root / "transforms_test.json", "test")
        frames, skipped = frames + test_frames, skipped + test_skipped
    else:
        frames = [replace(frame, split=None) for frame in frames]
    return Capture("blender", tuple(frames), skipped=tuple(skipped), notes=tuple(notes))


def read_nerfstudio(root: Path) -> Capture:
    """Read ``transforms.json`` of nerfstudio or instant-ngp.

    Intrinsics and distortion are shared or per frame; frames whose file does not exist are skipped and reported;
    ``train_filenames`` and ``test_filenames`` (or ``val_filenames`` where there is no test) give the split;
    ``ply_file_path`` gives sparse points. Everything stays in the frame of the file: ``applied_transform`` and
    ``scale`` describe what was already done to it.

    Raises
    ------
    DataError
        A broken or incomplete JSON file; names the file, the frame and the key.
    """
    path = root / "transforms.json"
    meta = _read_meta(path)
    frames, skipped, notes = _read_frames(path, None, meta)
    frames, unlisted = _named_split(path, meta, frames)
    if "applied_transform" in meta:
        notes.append("the file says applied_transform: poses and results are in the file's frame, not the original's")
    points = None
    if meta.get("ply_file_path") is not None:
        ply = root / _relative(meta["ply_file_path"], f"{path}: ply_file_path")
        if ply.is_file():
            cloud = read_points(ply)
            points = PointCloud(np.asarray(cloud.points, dtype=np.float64), cloud.colors)
        else:
            notes.append(f"ply_file_path {meta['ply_file_path']} does not exist: the scene has no sparse points")
    return Capture("nerfstudio", tuple(frames), points, skipped=tuple(skipped + unlisted), notes=tuple(notes))


def _read_meta(path: Path) -> dict[str, Any]:
    meta = read_json(path)
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list):
        got = f"the keys {sorted(meta)[:12]}" if isinstance(meta, dict) else type(meta).__name__
        raise DataError(f'{path} must be an object with a list "frames", got {got}')
    return meta


def _read_frames(
    path: Path, split: str | None, meta: dict[str, Any] | None = None
) -> tuple[list[PosedImage], list[str], list[str]]:
    """(frames whose file exists, sentences about those whose does not, notes)."""
    meta = _read_meta(path) if meta is None else meta
    root = path.parent
    frames: list[PosedImage] = []
    skipped: list[str] = []
    missing_masks = 0
    for index, entry in enumerate(meta["frames"]):
        where = f"{path} frame {index}"
        if not isinstance(entry, dict):
            raise DataError(f"{where} must be an object, got {type(entry).__name__}")
        name = _relative(_required(entry, "file_path", where), f"{where}: file_path")
        image = _find_image(root, name)
        if image is None:
            skipped.append(f"{name}: listed in {path.name}, but there is no such file")
            continue
        mask = None
        if entry.get("mask_path") is not None:
            mask = root / _relative(entry["mask_path"], f"{where}: mask_path")
            if not mask.is_file():
                mask, missing_masks = None, missing_masks + 1
        pose = pose_from_camera_to_world(
            _required(entry, "transform_matrix", where), f"{where} ({name}): transform_matrix", opengl=True
        )
        intrinsics = frame_intrinsics({**meta, **entry}, image, f"{where} ({name})")
        maps = _maps_of({**meta, **entry}, entry, root, where)
        inside = image.relative_to(root) if image.is_relative_to(root) else Path(*image.parts[1:])  # of another folder
        frames.append(PosedImage(inside.as_posix(), image, intrinsics, pose, split, mask=mask, maps=maps))
    notes = [f"{missing_masks} masks named in {path.name} do not exist"] if missing_masks else []
    return frames, skipped, notes


def _maps_of(both: Mapping[str, Any], entry: Mapping[str, Any], root: Path, where: str) -> MapFiles | None:
    """Return the maps that a frame names (``depth_file_path``, ``normal_file_path``), as far as they exist."""
    paths = {}
    for what in ("depth", "normal"):
        if entry.get(f"{what}_file_path") is not None:
            path = root / _relative(entry[f"{what}_file_path"], f"{where}: {what}_file_path")
            if path.is_file():
                paths[what] = path
    unit = both.get("depth_unit_scale_factor")
    if unit is not None and (isinstance(unit, bool) or not isinstance(unit, int | float) or not 0 < unit < _LARGEST):
        raise DataError(f"{where}: depth_unit_scale_factor must be a positive number, got {str(unit)[:40]!r}")
    return MapFiles(**paths, unit=unit, metric="depth" in paths) if paths else None


def _required(entry: Mapping[str, Any], key: str, where: str) -> Any:
    if key not in entry:
        raise DataError(f'{where} must have the key "{key}", got {sorted(entry)[:12]}')
    return entry[key]


def _relative(value: Any, where: str) -> str:
    """Return a path as written in a file, with ``/`` and without a leading ``./``."""
    if not isinstance(value, str) or not value:
        raise DataError(f"{where} must be a path, got {value!r}")
    return Path(value.replace("\\", "/")).as_posix()


def _find_image(root: Path, name: str) -> Path | None:
    """Return the file ``name``, which may come without its extension (NeRF-Synthetic)."""
    if (root / name).is_file():
        return root / name
    return next((root / (name + suffix) for suffix in _SUFFIXES if (root / (name + suffix)).is_file()), None)


def frame_intrinsics(entry: Mapping[str, Any], image: Path, where: str) -> Intrinsics:
    """Intrinsics of one frame, from its own keys or the file's.

    ``fl_x``, ``fl_y`` in pixels win over ``camera_angle_x``, ``camera_angle_y``, which are fields of view and so fit
    an image of any size: f = 0.5 W / tan(0.5 angle). Without ``w``, ``h`` the size is the file's.

    Raises
    ------
    DataError
        No focal length, a value that is no number, or a camera model that cannot be undistorted.
    """

    def number(key: str) -> float | None:
        value = entry.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST:
            raise DataError(f"{where}: {key} must be a finite number, got {str(value)[:40]!r}")
        return float(value)

    w, h = number("w"), number("h")
    width, height = (round(w), round(h)) if w and h else image_size(image)
    if _model(entry) == _PANORAMA:
        return panorama(width, height, where)
    fl_x, fl_y = number("fl_x"), number("fl_y")
    fx = fl_x if fl_x is not None else _focal(number("camera_angle_x"), width, f"{where}: camera_angle_x")
    fy = fl_y
    if fy is None and fl_x is None:  # square pixels of a stated fl_x are surer than an angle
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
        _lens(entry, {key: number(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2")}, where),
    )


def _focal(angle: float | None, size: int, where: str) -> float | None:
    """Focal length in pixels of a full field of view in radians."""
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise DataError(f"{where} must be between 0 and pi, got {angle}")
    return 0.5 * size / math.tan(0.5 * angle)


def _model(entry: Mapping[str, Any]) -> str:
    return str(entry.get("camera_model", "OPENCV_FISHEYE" if entry.get("is_fisheye") else "OPENCV")).upper()


def _lens(entry: Mapping[str, Any], value: Mapping[str, float], where: str) -> Lens | None:
    model = _model(entry)
    if model not in _PERSPECTIVE | _FISHEYE:
        raise DataError(
            f"{where}: camera_model {model} cannot be undistorted here "
            f"(known: {', '.join(sorted(_PERSPECTIVE | _FISHEYE | {_PANORAMA}))}); undistort the images first"
        )
    if "PINHOLE" in model and any(value.values()):
        bent = {key: number for key, number in value.items() if number}
        raise DataError(f"{where}: camera_model {model} must have no distortion, got {bent}; is it OPENCV?")
    radial = tuple(value[f"k{i}"] for i in (1, 2, 3, 4))
    lens = Lens("fisheye", radial) if model in _FISHEYE else Lens("perspective", radial, (), (value["p1"], value["p2"]))
    return None if lens.is_identity or "PINHOLE" in model else lens


def _named_split(path: Path, meta: dict[str, Any], frames: list[PosedImage]) -> tuple[list[PosedImage], list[str]]:
    """Return the frames with the split that the file names, and sentences about frames that it does not name."""
    lists: dict[str, set[str]] = {}
    for key in ("train", "val", "test"):
        names = meta.get(f"{key}_filenames")
        if names is None:
            continue
        if not isinstance(names, list):
            raise DataError(f"{path}: {key}_filenames must be a list of paths, got {type(names).__name__}")
        lists[key] = {_relative(name, f"{path}: {key}_filenames") for name in names}
    if "train" not in lists:
        return frames, []
    test = lists.get("test") or lists.get("val") or set()
    split, unlisted = [], []
    for frame in frames:
        names_of = {frame.name, Path(frame.name).with_suffix("").as_posix()}
        if names_of & lists["train"]:
            split.append(replace(frame, split="train"))
        elif names_of & test:
            split.append(replace(frame, split="test"))
        else:
            unlisted.append(f"{frame.name}: in none of the lists of {path.name} that are used")
    return split, unlisted
