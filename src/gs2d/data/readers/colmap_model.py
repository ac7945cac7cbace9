"""COLMAP's model files, binary and text: cameras, images, points3D.

The layouts are those of COLMAP's documentation (https://colmap.github.io/format.html). ``rigs`` and ``frames`` files,
which newer versions write beside them, repeat the poses in another form and are not read.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import DataError

#: model id -> (name, number of parameters)
CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}


@dataclass(frozen=True)
class ColmapCamera:
    """One line of cameras: the model's name and its parameters in COLMAP's order, px."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """One registered image.

    Attributes
    ----------
    image_id, camera_id : int
    name : str
        Relative to the image folder.
    T_cam_world : ndarray [4, 4] float64
    observations : ndarray [M, 2] px and point_ids : ndarray [M] int64 (-1 = none), or None if they were not asked for
    """

    image_id: int
    camera_id: int
    name: str
    T_cam_world: np.ndarray
    observations: np.ndarray | None = None
    point_ids: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class ColmapPoints:
    """ids [P] int64, xyz [P, 3] float64 world units, rgb [P, 3] uint8, error [P] px."""

    ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray


def find_model(folder: Path) -> str | None:
    """Return "bin" or "txt" if ``folder`` holds a COLMAP model of that kind (binary is preferred), else None."""
    for kind in ("bin", "txt"):
        if (folder / f"cameras.{kind}").is_file() and (folder / f"images.{kind}").is_file():
            return kind
    return None


def read_cameras(folder: Path, kind: str) -> dict[int, ColmapCamera]:
    """All cameras of a model, by id. Raises DataError for a file that is cut short or not a camera list."""
    path = folder / f"cameras.{kind}"
    return dict(_cameras_bin(path) if kind == "bin" else _cameras_txt(path))


def read_images(folder: Path, kind: str, *, observations: bool = False) -> list[ColmapImage]:
    """All registered images of a model, in the file's order; ``observations`` also keeps the 2-D points.

    Raises
    ------
    DataError
        A file that is cut short or not an image list, or a pose that is not a pose.
    """
    path = folder / f"images.{kind}"
    return list(_images_bin(path, observations) if kind == "bin" else _images_txt(path, observations))


def read_points(folder: Path, kind: str) -> ColmapPoints | None:
    """Return the sparse points, or None if the model has no such file. Raises DataError as the others."""
    path = folder / f"points3D.{kind}"
    if not path.is_file():
        return None
    return _points_bin(path) if kind == "bin" else _points_txt(path)


class _Bytes:
    """A binary file that says where it was cut."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.at = 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise DataError(f"cannot read {path}: {error.strerror or error}") from error

    def need(self, count: int, what: str) -> int:
        """Move over ``count`` bytes and return where they start."""
        start = self.at
        if start + count > len(self.data):
            raise DataError(
                f"{self.path} is truncated or not a COLMAP file: {what} needs bytes {start} to {start + count}, "
                f"got a file of {len(self.data)} bytes; copy it again"
            )
        self.at = start + count
        return start

    def unpack(self, layout: str, what: str) -> tuple[int | float, ...]:
        return struct.unpack_from("<" + layout, self.data, self.need(struct.calcsize("<" + layout), what))

    def count(self, what: str, smallest: int) -> int:
        """Return the number of records that follow, each of at least ``smallest`` bytes."""
        count = int(self.unpack("Q", f"the number of {what}")[0])
        if self.at + count * smallest > len(self.data):
            raise DataError(
                f"{self.path} is truncated or not a COLMAP file: {count} {what} need at least "
                f"{self.at + count * smallest} bytes, got {len(self.data)}; copy it again"
            )
        return count

    def name(self, what: str) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            self.need(len(self.data) - self.at + 1, what)
        raw = self.data[self.at : end]
        self.at = end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise DataError(f"{self.path}: {what} must be UTF-8, got {raw[:40]!r}; is this a COLMAP file?") from error

    def finish(self, what: str) -> None:
        if self.at != len(self.data):
            raise DataError(
                f"{self.path} must end after its last {what} at byte {self.at}, got {len(self.data)} bytes; "
                "is this a COLMAP file?"
            )


def _cameras_bin(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    file = _Bytes(path)
    count = file.count("cameras", 24 + 3 * 8)
    for number in range(1, count + 1):
        what = f"camera {number} of {count}"
        camera_id, model_id, width, height = map(int, file.unpack("IiQQ", what))
        if model_id not in CAMERA_MODELS:
            raise DataError(
                f"{path}: camera {camera_id} has the model id {model_id}, which is not known here (0 to "
                f"{max(CAMERA_MODELS)}); run `colmap image_undistorter` and load its output"
            )
        model, num_params = CAMERA_MODELS[model_id]
        yield camera_id, ColmapCamera(model, width, height, file.unpack(f"{num_params}d", what))
    file.finish("camera")


def _images_bin(path: Path, observations: bool) -> Iterator[ColmapImage]:
    file = _Bytes(path)
    count = file.count("images", 64 + 1 + 8)
    for number in range(1, count + 1):
        what = f"image {number} of {count}"
        image_id, *pose, camera_id = file.unpack("I7dI", what)
        name = file.name(f"the name of {what}")
        (num_points,) = map(int, file.unpack("Q", what))
        start = file.need(24 * num_points, f"the {num_points} 2-D points of {what}")
        T = pose_matrix(pose[:4], pose[4:], f"{path}: image {name}")
        xys = ids = None
        if observations:
            table = np.frombuffer(file.data, dtype="<f8, <f8, <i8", count=num_points, offset=start)
            xys, ids = np.stack([table["f0"], table["f1"]], axis=1), table["f2"].astype(np.int64)
        yield ColmapImage(int(image_id), int(camera_id), name, T, xys, ids)
    file.finish("image")


def _points_bin(path: Path) -> ColmapPoints:
    file = _Bytes(path)
    count = file.count("points", 43 + 8)
    offsets = np.empty(count, dtype=np.int64)
    data, at, size, track_length = file.data, file.at, len(file.data), struct.Struct("<Q").unpack_from
    for row in range(count):
        # Written out for speed: a million points take a second.
        end = at + 51
        if end <= size:
            offsets[row] = at
            end += 8 * track_length(data, at + 43)[0]
        if end > size:
            file.at = at
            file.need(end - at, f"point {row + 1} of {count}")
        at = end
    file.at = at
    file.finish("point")
    raw = np.frombuffer(data, dtype=np.uint8)
    records = raw[offsets[:, None] + np.arange(43)] if count else np.empty((0, 43), dtype=np.uint8)
    records = np.ascontiguousarray(records)
    return ColmapPoints(
        ids=records[:, :8].copy().view("<u8")[:, 0].astype(np.int64),
        xyz=records[:, 8:32].copy().view("<f8").astype(np.float64),
        rgb=records[:, 32:35].copy(),
        error=records[:, 35:43].copy().view("<f8")[:, 0].astype(np.float64),
    )


def _lines(path: Path) -> list[tuple[int, str]]:
    """(line number, text) of all lines but comments; empty lines stay (an image without 2-D points has one)."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path} must be text in UTF-8, got other bytes; is it a COLMAP file?") from error
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    return [(n, line.strip()) for n, line in enumerate(text.splitlines(), 1) if not line.lstrip().startswith("#")]


def _wrong_line(path: Path, number: int, expected: str, error: Exception) -> DataError:
    return DataError(f"{path} line {number} must be `{expected}`, got: {error}; is the file complete?")


def _cameras_txt(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        try:
            camera_id = int(words[0])
            camera = ColmapCamera(words[1], int(words[2]), int(words[3]), tuple(map(float, words[4:])))
        except (ValueError, IndexError) as error:
            raise _wrong_line(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS...", error) from error
        yield camera_id, camera


def _images_txt(path: Path, observations: bool) -> Iterator[ColmapImage]:
    lines = _lines(path)
    while lines and not lines[-1][1]:
        lines.pop()
    at = 0
    while at < len(lines):
        number, line = lines[at]
        if not line:  # a blank line between records
            at += 1
            continue
        points = lines[at + 1][1] if at + 1 < len(lines) else ""
        yield _image_txt(path, number, line, points, observations)
        at += 2


def _image_txt(path: Path, number: int, line: str, points: str, observations: bool) -> ColmapImage:
    expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    words = line.split(maxsplit=9)  # a name may hold spaces
    try:
        image_id, camera_id, name = int(words[0]), int(words[8]), words[9]
        pose = [float(word) for word in words[1:8]]
        table = np.array(points.split(), dtype=np.float64).reshape(-1, 3) if observations else None
    except (ValueError, IndexError) as error:
        raise _wrong_line(path, number, expected, error) from error
    T = pose_matrix(pose[:4], pose[4:], f"{path}: image {name}")
    if table is None:
        return ColmapImage(image_id, camera_id, name, T)
    return ColmapImage(image_id, camera_id, name, T, table[:, :2], table[:, 2].astype(np.int64))


def _points_txt(path: Path) -> ColmapPoints:
    rows = []
    for number, line in _lines(path):
        if not line:
            continue
        words = line.split(maxsplit=8)
        try:
            rows.append([float(word) for word in words[:8]])
            if len(words) < 8:
                raise ValueError(f"{len(words)} words")
        except ValueError as error:
            raise _wrong_line(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK...", error) from error
    table = np.array(rows, dtype=np.float64).reshape(-1, 8)
    return ColmapPoints(
        table[:, 0].astype(np.int64), table[:, 1:4].copy(), table[:, 4:7].astype(np.uint8), table[:, 7].copy()
    )


def pose_matrix(quat: list[float], translation: list[float], where: str) -> np.ndarray:
    """T_cam_world [4, 4] of COLMAP's (w, x, y, z) and translation.

    Raises
    ------
    DataError
        NaN, infinity or a zero quaternion.
    """
    norm = math.sqrt(sum(q * q for q in quat))
    if not (math.isfinite(norm) and norm > 1e-8 and all(map(math.isfinite, translation))):
        raise DataError(f"{where} must have a finite pose, got quaternion {quat} and translation {translation}")
    T = np.eye(4)
    T[:3, :3] = quats_to_matrices(torch.tensor([quat], dtype=torch.float64))[0].numpy()
    T[:3, 3] = translation
    return T
