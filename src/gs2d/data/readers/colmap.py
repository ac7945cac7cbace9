"""COLMAP captures: a folder of images and a sparse model."""

from __future__ import annotations

import math
import mmap
import os
import shlex
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from gs2d.core.image_arrays import is_number, natural_key
from gs2d.core.json_files import read_bytes
from gs2d.core.transforms import quats_to_matrices
from gs2d.data.build import Capture, PosedImage, skipping
from gs2d.data.faces import panorama
from gs2d.data.file_names import ImageFile, find_photographs, in_any_case, parsed
from gs2d.data.image_files import image_size
from gs2d.data.prior_maps import ObservedPoints
from gs2d.data.readers.capture_readers import register_reader
from gs2d.data.scene import PointCloud
from gs2d.data.undistort import COLMAP_MODELS, Intrinsics, colmap_intrinsics
from gs2d.errors import DataError, UnusableViewError

# -- the files of a model ----------------------------------------------------------------------------------------------
# Layouts: https://colmap.github.io/format.html. ``rigs`` and ``frames`` files of newer versions repeat the poses in
# another form and are not read.
PANORAMA = "EQUIRECTANGULAR"


@dataclass(frozen=True)
class ColmapCamera:
    """A camera: name of the camera model, image size, and parameters in COLMAP's order, px."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image."""

    image_id: int
    camera_id: int
    name: str  # relative to the image folder
    T_cam_world: np.ndarray  # [4, 4] float64; NaN if the file has no valid pose
    observations: np.ndarray | None = None  # [M, 2] px; None: not requested
    point_ids: np.ndarray | None = None  # [M] int64, -1 = no point; None: not requested


@dataclass(frozen=True, eq=False)
class ColmapPoints:
    """Sparse points: ids [P] int64, xyz [P, 3] float64 world units, rgb [P, 3] uint8, error [P] px."""

    ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray


def find_model(folder: Path) -> str | None:
    """Return "bin" or "txt" if ``folder`` holds a COLMAP model (binary is preferred), else None."""
    for kind in ("bin", "txt"):
        if all(_file(folder, name, kind).is_file() for name in ("cameras", "images")):
            return kind
    return None


def _file(folder: Path, name: str, kind: str) -> Path:
    """Return the path of a model file; some programs write ``Cameras.txt`` or ``points3d.txt``."""
    return in_any_case(folder, f"{name}.{kind}")


def read_cameras(folder: Path, kind: str) -> dict[int, ColmapCamera]:
    """Read the cameras of a model, by id; raises DataError for a truncated or invalid file."""
    path = _file(folder, "cameras", kind)
    return dict(_cameras_bin(path) if kind == "bin" else _cameras_txt(path))


def read_images(folder: Path, kind: str, *, observations: bool = False) -> list[ColmapImage]:
    """Read the registered images of a model, in file order; ``observations`` includes the 2-D points.

    Raises DataError if the file is truncated or invalid, or a pose is not finite.
    """
    images = list(_each_image(folder, kind, observations))
    for image in images:
        _check_pose(image, _file(folder, "images", kind))
    return images


def _each_image(folder: Path, kind: str, observations: bool) -> Iterator[ColmapImage]:
    """Yield the images of ``read_images``, including those without a valid pose."""
    path = _file(folder, "images", kind)
    return _images_bin(path, observations) if kind == "bin" else _images_txt(path, observations)


def read_points(folder: Path, kind: str) -> ColmapPoints | None:
    """Read the sparse points; None if the model has no such file. Raises DataError like the others."""
    path = _file(folder, "points3D", kind)
    if not path.is_file():
        return None
    return _points_bin(path) if kind == "bin" else _points_txt(path)


_IMAGE_BYTES = 64 + 1 + 8  # size of an image without a name and 2-D points
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])
_CHUNK = 1 << 16  # points copied at a time


class _ModelFile:
    """A memory-mapped binary file; reading beyond its end is a DataError."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, 0
        try:
            with path.open("rb") as file:
                self.size = os.fstat(file.fileno()).st_size
                self.data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if self.size else b""
        except OSError as error:
            raise DataError(f"cannot read {path}: {error.strerror or error}") from error

    def take(self, count: int, what: str) -> int:
        """Move past ``count`` bytes and return the offset of the first."""
        start, self.at = self.at, self.at + count
        if self.at > self.size:
            raise DataError(
                f"{self.path} is truncated or not a COLMAP file: {what} needs bytes {start} to {self.at}, "
                f"got a file of {self.size} bytes; copy it again"
            )
        return start

    def unpack(self, layout: str, what: str) -> tuple[int | float, ...]:
        """Return the next values."""
        return struct.unpack_from("<" + layout, self.data, self.take(struct.calcsize("<" + layout), what))

    def count(self, what: str, smallest: int) -> int:
        """Return the number of records that follow, each of at least ``smallest`` bytes."""
        count = int(self.unpack("Q", f"the number of {what}")[0])
        self.at = self.take(count * smallest, f"a list of {count} {what}")
        return count

    def name(self, what: str) -> str:
        """Return the text up to the next zero byte."""
        end = self.data.find(b"\0", self.at)
        length = (self.size if end < 0 else end) - self.at
        start = self.take(length + 1, what)
        return self.data[start : start + length].decode("utf-8", "surrogateescape")  # as the file system has it

    def finish(self, what: str) -> None:
        """Check that the file ends here."""
        if self.at != self.size:
            raise DataError(
                f"{self.path} must end after its last {what} at byte {self.at}, got {self.size} bytes; "
                "is this a COLMAP file?"
            )


def _cameras_bin(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    file = _ModelFile(path)
    count = file.count("cameras", 24 + 2 * 8)  # size with the model of fewest parameters
    for number in range(1, count + 1):
        what = f"camera {number} of {count}"
        camera_id, model_id, width, height = map(int, file.unpack("IiQQ", what))
        if not 0 <= model_id < len(COLMAP_MODELS):
            raise DataError(
                f"{path}: camera {camera_id} has the unknown model id {model_id} (known: 0 to "
                f"{len(COLMAP_MODELS) - 1}); run `colmap image_undistorter` and load its output"
            )
        model = list(COLMAP_MODELS)[model_id]
        yield camera_id, ColmapCamera(model, width, height, file.unpack(f"{COLMAP_MODELS[model][0]}d", what))
    file.finish("camera")


def _images_bin(path: Path, observations: bool) -> Iterator[ColmapImage]:
    file = _ModelFile(path)
    count = file.count("images", _IMAGE_BYTES)
    for number in range(1, count + 1):
        what = f"image {number} of {count}"
        image_id, *pose, camera_id = file.unpack("I7dI", what)
        name = file.name(f"the name of {what}")
        (num_points,) = map(int, file.unpack("Q", what))
        start = file.take(24 * num_points, f"the {num_points} 2-D points of {what}")
        image = ColmapImage(int(image_id), int(camera_id), name, pose_matrix(pose[:4], pose[4:]))
        if observations:
            table = np.frombuffer(file.data, dtype="<f8, <f8, <i8", count=num_points, offset=start)
            xys, ids = np.stack([table["f0"], table["f1"]], axis=1), table["f2"].astype(np.int64)
            image = replace(image, observations=xys, point_ids=ids)
        yield image
    file.finish("image")


def _points_bin(path: Path) -> ColmapPoints:
    file = _ModelFile(path)
    count = file.count("points", _POINT.itemsize + 8)
    starts, track_length = np.empty(count, dtype=np.int64), struct.Struct("<Q").unpack_from
    for i in range(count):
        starts[i] = file.at
        length = track_length(file.data, file.at + _POINT.itemsize)[0] if file.at + 51 <= file.size else 0
        file.take(51 + 8 * length, f"point {i + 1} of {count}")
    file.finish("point")
    raw, records = np.frombuffer(file.data, dtype=np.uint8), np.empty(count, _POINT)
    for begin in range(0, count, _CHUNK):
        part = records[begin : begin + _CHUNK]
        part.view(np.uint8).reshape(-1, _POINT.itemsize)[:] = raw[
            starts[begin : begin + _CHUNK, None] + np.arange(_POINT.itemsize)
        ]
    return ColmapPoints(
        ids=records["id"].astype(np.int64),
        xyz=np.ascontiguousarray(records["xyz"], np.float64),
        rgb=np.ascontiguousarray(records["rgb"]),
        error=np.ascontiguousarray(records["error"], np.float64),
    )


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return (line number, text) without comments; empty lines stay (an image without 2-D points has one)."""
    text = read_bytes(path).decode("utf-8-sig", "surrogateescape")  # file names
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
            camera = ColmapCamera(words[1], int(words[2]), int(words[3]), tuple(map(parsed, words[4:])))
        except (ValueError, IndexError) as error:
            raise _wrong_line(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS...", error) from error
        yield camera_id, camera


def _images_txt(path: Path, observations: bool) -> Iterator[ColmapImage]:
    lines = _lines(path)
    at = 0
    while at < len(lines):
        number, line = lines[at]
        at += 1
        if not line:  # a blank line between records
            continue
        try:
            image = _image_txt(line)
        except (ValueError, IndexError) as error:
            raise _wrong_line(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", error) from error
        points = ""
        if at < len(lines) and not _is_image(lines[at][1]):  # scripts omit the empty lines
            number, points = lines[at]
            at += 1
        if observations:
            try:
                table = np.array(list(map(float, points.split()))).reshape(-1, 3)
                image = replace(image, observations=table[:, :2], point_ids=_whole(table[:, 2], np.int64))
            except ValueError as error:
                raise _wrong_line(path, number, "X Y POINT3D_ID, for each 2-D point of an image", error) from error
        yield image


def _image_txt(line: str) -> ColmapImage:
    """Parse the line of an image; raises ValueError or IndexError."""
    words = line.split(maxsplit=9)  # a name may hold spaces
    image_id, camera_id, name = int(words[0]), int(words[8]), words[9]
    pose = [parsed(word) for word in words[1:8]]
    return ColmapImage(image_id, camera_id, name, pose_matrix(pose[:4], pose[4:]))


def _is_image(line: str) -> bool:
    """Whether a line has nine numbers and a name; a line of 2-D points has only numbers."""
    try:
        words = _image_txt(line).name.split()
    except (ValueError, IndexError):
        return False
    try:
        parsed(words[0])
        parsed(words[-1])
    except ValueError:
        return True
    return (9 + len(words)) % 3 != 0


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
    try:
        ids, rgb = _whole(table[:, 0], np.int64), _whole(table[:, 4:7], np.uint8)
    except ValueError as error:
        raise DataError(f"{path} must hold whole numbers as ids and colours, got: {error}") from error
    return ColmapPoints(ids, table[:, 1:4].copy(), rgb, table[:, 7].copy())


def _whole(values: np.ndarray, dtype: type[np.integer]) -> np.ndarray:
    """Convert floats to integers; raises ValueError for NaN and numbers out of range."""
    low, high = float(np.iinfo(dtype).min), float(np.iinfo(dtype).max)
    wrong = values[~((values >= low) & (values <= high) & (values < 2.0**63))]
    if wrong.size:
        raise ValueError(f"{wrong.flat[0]:g}, which is not a valid {np.dtype(dtype).name}")
    return values.astype(dtype)


def pose_matrix(quat: list[float], translation: list[float]) -> np.ndarray:
    """Return T_cam_world [4, 4] of a quaternion (w, x, y, z) and a translation; NaN if they are invalid."""
    norm = math.sqrt(sum(q * q for q in quat))
    if not (math.isfinite(norm) and norm > 1e-8 and all(map(math.isfinite, translation))):
        return np.full((4, 4), np.nan)
    T = np.eye(4)
    T[:3, :3] = quats_to_matrices(torch.tensor([quat], dtype=torch.float64))[0].numpy()
    T[:3, 3] = translation
    return T


def _check_pose(image: ColmapImage, path: Path) -> None:
    if not np.isfinite(image.T_cam_world).all():
        raise UnusableViewError(f"{path}: image {image.name} must have a finite pose and a non-zero quaternion")


# -- the scene ---------------------------------------------------------------------------------------------------------
MODEL_FOLDERS = ("sparse/0", "sparse", ".")


def model_folder(root: Path) -> tuple[Path, str] | None:
    """Return the folder and kind ("bin" or "txt") of the model, or None.

    Takes the largest of ``sparse/0``, ``sparse/1``, ..., else ``sparse``, else ``root`` itself.
    """
    sparse = in_any_case(root, "sparse")
    numbered = [model for model in _models_in(sparse) if is_number(model.name)]
    folders = [max(numbered, key=_num_images)] if len(numbered) > 1 else numbered
    for folder in (*folders, sparse, root):
        kind = find_model(folder)
        if kind is not None:
            return folder, kind
    return None


def _models_in(folder: Path) -> list[Path]:
    """Return the sub-folders that hold a model, in numeric order."""
    if not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if find_model(path)), key=lambda path: natural_key(path.name))


def _num_images(folder: Path) -> int:
    """Return the number of images of a model; 0 if its file is invalid."""
    kind = find_model(folder) or "bin"
    path = _file(folder, "images", kind)
    try:
        if kind == "txt":
            return sum(1 for _ in _images_txt(path, observations=False))
        return _ModelFile(path).count("images", _IMAGE_BYTES)
    except DataError:
        return 0


def read_colmap(root: Path, downscale: int) -> Capture:
    """Read a COLMAP capture.

    Images are in ``images`` beside ``sparse``, or in ``images_N`` if ``downscale`` is N and that folder exists. EXIF
    orientation is ignored, as in COLMAP. Raises DataError if the model is missing or invalid, a camera model is not
    supported, or there is no folder of images.
    """
    model = model_folder(root)
    if model is None:
        raise DataError(
            f"{root} must hold a COLMAP model: cameras.bin and images.bin (or .txt) in sparse/0, sparse or itself"
        )
    folder, kind = model
    cameras = read_cameras(folder, kind)
    images = list(_each_image(folder, kind, observations=False))
    home, photographs = _photographs(root, folder, kind, images)
    notes: list[str] = _other_models(folder)
    scaled = in_any_case(home, f"images_{downscale}")
    factor = 1
    if downscale > 1 and scaled.is_dir():
        smaller = _image_files(images, [scaled], _file(folder, "images", kind))
        if any(photo.path is not None for photo in smaller.values()):
            photographs, factor = smaller, downscale
            notes.append(f"images of 1/{downscale} size are read from {scaled.name}")
        else:
            notes.append(f"{scaled.name} holds no images of the model and is not used")
    frames: list[PosedImage] = []
    skipped: list[str] = []
    intrinsics: dict[int, Intrinsics] = {}
    for image in images:
        photo = photographs[image.name]
        if photo.path is None:
            skipped.append(f"{image.name}: {photo.reason}")
            continue
        with skipping(image.name, skipped):
            _check_pose(image, _file(folder, "images", kind))
            if image.camera_id not in intrinsics:
                intrinsics[image.camera_id] = _intrinsics(_file(folder, "cameras", kind), cameras, image)
            k = intrinsics[image.camera_id]
            if factor > 1:
                _check_factor(photo.path, k, factor)
            frames.append(PosedImage(photo.name, photo.path, k, image.T_cam_world))
    return Capture(
        "colmap",
        tuple(frames),
        points=model_points(folder, kind),
        downscaled_by=factor,
        skipped=tuple(skipped),
        notes=tuple(notes),
        home=home,
        observe=partial(observed_points, folder, kind, {name: photo.name for name, photo in photographs.items()}),
    )


@register_reader("colmap")
class Colmap:
    """Reader of COLMAP captures; ``images_N`` has downscaled images."""

    looks_for = f"cameras.bin and images.bin (or .txt) in {', '.join(MODEL_FOLDERS)} (COLMAP)"

    def detect(self, path: Path) -> bool:
        """Whether the folder has a model."""
        return model_folder(path) is not None

    def read(self, path: Path, *, downscale: int) -> Capture:
        """Read a capture."""
        return read_colmap(path, downscale)


def observed_points(folder: Path, kind: str, names: Mapping[str, str] | None = None) -> ObservedPoints:
    """Return the points that each image of a model observes.

    ``names``: view names by image name in the model; default: the same. Raises DataError if the model has no points, or
    a file is invalid.
    """
    points = read_points(folder, kind)
    if points is None or not len(points.ids):
        raise DataError(f"{folder} must hold sparse points in points3D.{kind}, got none")
    order = np.argsort(points.ids)
    track = np.zeros(len(order), dtype=np.int64)
    by_view = {}
    for image in _each_image(folder, kind, observations=True):  # one at a time: observations are large
        assert image.point_ids is not None
        ids = np.unique(image.point_ids[image.point_ids >= 0])
        at = order[np.searchsorted(points.ids, ids, sorter=order).clip(max=len(order) - 1)]
        rows = at[points.ids[at] == ids]
        by_view[image.name if names is None else names.get(image.name, image.name)] = rows.astype(np.int32)
        track[rows] += 1
    return ObservedPoints(points.xyz, points.error, track, by_view)


def model_points(folder: Path, kind: str) -> PointCloud | None:
    """Return the sparse points of a model; None without any."""
    points = read_points(folder, kind)
    return None if points is None or not len(points.xyz) else PointCloud(points.xyz, points.rgb)


def _intrinsics(path: Path, cameras: dict[int, ColmapCamera], image: ColmapImage) -> Intrinsics:
    camera = cameras.get(image.camera_id)
    if camera is None:
        raise DataError(
            f"{path} must hold camera {image.camera_id} of image {image.name}, got {sorted(cameras)[:9] or 'none'}; is "
            "the file complete? Export it again"
        )
    where = f"{path}: camera {image.camera_id}"
    if camera.model == PANORAMA:
        size = (camera.width, camera.height)
        if camera.params != size:
            raise DataError(
                f"{where}: the model {PANORAMA} must have the size {size} as parameters, got {camera.params}"
            )
        return panorama(*size, where)
    return colmap_intrinsics(where, camera.model, camera.width, camera.height, camera.params)


def _photographs(root: Path, model: Path, kind: str, images: list[ColmapImage]) -> tuple[Path, dict[str, ImageFile]]:
    """Return the folder that holds ``images`` and ``sparse``, and the image files by name in the model."""
    homes = list(dict.fromkeys([root, model.parent, model.parent.parent]))
    listing = _file(model, "images", kind)
    for home in homes:
        if (at := in_any_case(home, "images")).is_dir():
            return home, _image_files(images, [at], listing)
    exact = (home for home in homes if any((home / image.name).is_file() for image in images))
    home = next(exact, root)  # folders above root are not searched
    photographs = _image_files(images, [home], listing)
    if any(photo.path is not None for photo in photographs.values()):
        return home, photographs
    raise DataError(
        f"{root} must have its images in the folder images, which does not exist; copy the image folder that COLMAP "
        "used there, under that name"
    )


def _image_files(images: list[ColmapImage], folders: list[Path], listing: Path) -> dict[str, ImageFile]:
    reason = f"no such file in {folders[0].name}"
    return find_photographs([image.name for image in images], folders, listing, reason=reason)


def _other_models(folder: Path) -> list[str]:
    """Return a note on other models beside the selected one."""
    others = [path for path in _models_in(folder.parent) if path != folder] if is_number(folder.name) else []
    if not others:
        return []
    sizes = ", ".join(f"{path.name} has {_num_images(path)}" for path in others)
    return [
        f"using the model {folder.parent.name}/{folder.name} with {_num_images(folder)} images; {sizes}. "
        f"To use another one, give its folder: gs2d train {shlex.quote(str(others[0]))}"
    ]


def _check_factor(path: Path, k: Intrinsics, factor: int) -> None:
    """Check that a file in ``images_N`` has 1/N of the camera's image size, up to rounding."""
    size, expected = np.array(image_size(path)), np.array((k.width, k.height)) / factor
    if (np.abs(size - expected) > np.maximum(1.0, 0.01 * expected)).any():
        raise DataError(
            f"{path} must be 1/{factor} of its camera's {k.width}x{k.height}, got {size[0]}x{size[1]}; "
            f"remove or rebuild the folder {path.parent.name}"
        )
