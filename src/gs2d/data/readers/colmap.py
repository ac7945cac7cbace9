"""A folder with photographs and a COLMAP model."""

from __future__ import annotations

import math
import os
import shlex
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from gs2d.core.images import is_number, natural_key
from gs2d.core.transforms import quats_to_matrices
from gs2d.data.build import Capture, PosedImage, skipping
from gs2d.data.faces import panorama
from gs2d.data.file_names import in_any_case
from gs2d.data.image_files import image_size
from gs2d.data.priors import ObservedPoints
from gs2d.data.readers.common import Photograph, find_photographs, parsed
from gs2d.data.scene import PointCloud
from gs2d.data.undistort import Intrinsics, colmap_intrinsics
from gs2d.errors import DataError, UnusableViewError

# -- the files of a model ----------------------------------------------------------------------------------------------
# The layouts are those of COLMAP's documentation (https://colmap.github.io/format.html). ``rigs`` and ``frames`` files,
# which newer versions write beside them, repeat the poses in another form and are not read.
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
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}

PANORAMA = "EQUIRECTANGULAR"


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
        NaN where the file has no valid pose.
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
        if all(_file(folder, name, kind).is_file() for name in ("cameras", "images")):
            return kind
    return None


def _file(folder: Path, name: str, kind: str) -> Path:
    """Return a file of a model, which some programs begin with a capital (``Cameras.txt``, ``points3d.txt``)."""
    return in_any_case(folder, f"{name}.{kind}")


def read_cameras(folder: Path, kind: str) -> dict[int, ColmapCamera]:
    """All cameras of a model, by id. Raises DataError for a file that is cut short or not a camera list."""
    path = _file(folder, "cameras", kind)
    return dict(_cameras_bin(path) if kind == "bin" else _cameras_txt(path))


def read_images(folder: Path, kind: str, *, observations: bool = False) -> list[ColmapImage]:
    """All registered images of a model, in the file's order; ``observations`` also keeps the 2-D points.

    Raises
    ------
    DataError
        A file that is cut short or not an image list, or a pose that is not a pose.
    """
    images = list(_each_image(folder, kind, observations))
    for image in images:
        _check_pose(image, _file(folder, "images", kind))
    return images


def _each_image(folder: Path, kind: str, observations: bool) -> Iterator[ColmapImage]:
    """Yield the images of ``read_images`` one by one, those without a valid pose too."""
    path = _file(folder, "images", kind)
    return _images_bin(path, observations) if kind == "bin" else _images_txt(path, observations)


def read_points(folder: Path, kind: str) -> ColmapPoints | None:
    """Return the sparse points, or None if the model has no such file. Raises DataError as the others."""
    path = _file(folder, "points3D", kind)
    if not path.is_file():
        return None
    return _points_bin(path) if kind == "bin" else _points_txt(path)


_IMAGE_BYTES = 64 + 1 + 8  # of an image without a name and 2-D points
_CHUNK = 1 << 22  # bytes of points at a time


class _Bytes:
    """A binary file, read piece by piece, that says where it was cut: models are larger than what is kept of them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.at = 0
        try:
            self._file = path.open("rb")
            self.size = os.fstat(self._file.fileno()).st_size
        except OSError as error:
            raise self._unreadable(error) from error

    def __enter__(self) -> _Bytes:
        return self

    def __exit__(self, *raised: object) -> None:
        self._file.close()

    def _unreadable(self, error: OSError) -> DataError:
        return DataError(f"cannot read {self.path}: {error.strerror or error}")

    def need(self, count: int, what: str) -> None:
        """Raise DataError where the file ends before ``count`` more bytes."""
        if self.at + count > self.size:
            raise DataError(
                f"{self.path} is truncated or not a COLMAP file: {what} needs bytes {self.at} to {self.at + count}, "
                f"got a file of {self.size} bytes; copy it again"
            )

    def read(self, count: int, what: str) -> bytes:
        """Return the next ``count`` bytes."""
        self.need(count, what)
        try:
            data = self._file.read(count)
        except OSError as error:
            raise self._unreadable(error) from error
        if len(data) < count:  # it became shorter meanwhile
            self.size = self.at + len(data)
            self.need(count, what)
        self.at += count
        return data

    def skip(self, count: int, what: str) -> None:
        """Move over ``count`` bytes."""
        self.need(count, what)
        self.at += count
        self._file.seek(self.at)

    def unpack(self, layout: str, what: str) -> tuple[int | float, ...]:
        return struct.unpack("<" + layout, self.read(struct.calcsize("<" + layout), what))

    def count(self, what: str, smallest: int) -> int:
        """Return the number of records that follow, each of at least ``smallest`` bytes."""
        count = int(self.unpack("Q", f"the number of {what}")[0])
        if self.at + count * smallest > self.size:
            raise DataError(
                f"{self.path} is truncated or not a COLMAP file: {count} {what} need at least "
                f"{self.at + count * smallest} bytes, got {self.size}; copy it again"
            )
        return count

    def name(self, what: str) -> str:
        """Return the text up to the next byte 0."""
        start, raw = self.at, b""
        while b"\0" not in raw:
            rest = self.size - self.at
            raw += self.read(min(64, rest) if rest else 1, what)  # 1 is more than there is
        raw = raw[: raw.index(b"\0")]
        self.at = start + len(raw) + 1
        self._file.seek(self.at)
        return raw.decode("utf-8", "surrogateescape")  # as the file system has it

    def finish(self, what: str) -> None:
        if self.at != self.size:
            raise DataError(
                f"{self.path} must end after its last {what} at byte {self.at}, got {self.size} bytes; "
                "is this a COLMAP file?"
            )


def _cameras_bin(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    with _Bytes(path) as file:
        count = file.count("cameras", 24 + 2 * 8)  # of the model with fewest parameters
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
    with _Bytes(path) as file:
        count = file.count("images", _IMAGE_BYTES)
        for number in range(1, count + 1):
            what = f"image {number} of {count}"
            image_id, *pose, camera_id = file.unpack("I7dI", what)
            name = file.name(f"the name of {what}")
            (num_points,) = map(int, file.unpack("Q", what))
            points = f"the {num_points} 2-D points of {what}"
            xys = ids = None
            if observations:
                table = np.frombuffer(file.read(24 * num_points, points), dtype="<f8, <f8, <i8")
                xys, ids = np.stack([table["f0"], table["f1"]], axis=1), table["f2"].astype(np.int64)
            else:
                file.skip(24 * num_points, points)
            yield ColmapImage(int(image_id), int(camera_id), name, pose_matrix(pose[:4], pose[4:]), xys, ids)
        file.finish("image")


def _points_bin(path: Path) -> ColmapPoints:
    with _Bytes(path) as file:
        count = file.count("points", 43 + 8)
        records = np.empty((count, 43), dtype=np.uint8)
        done, rest = 0, b""
        while done < count:
            data = rest + file.read(min(_CHUNK, file.size - file.at), "points")
            offsets, used, needed = _point_offsets(data, count - done)
            if needed and (start := file.at - len(data) + used) + needed > file.size:
                file.at = start
                file.need(needed, f"point {done + len(offsets) + 1} of {count}")
            raw = np.frombuffer(data, dtype=np.uint8)
            records[done : done + len(offsets)] = raw[offsets[:, None] + np.arange(43, dtype=np.int32)]
            done, rest = done + len(offsets), data[used:]
        file.at -= len(rest)
        file.finish("point")
    return ColmapPoints(
        ids=records[:, :8].copy().view("<u8")[:, 0].astype(np.int64),
        xyz=records[:, 8:32].copy().view("<f8").astype(np.float64),
        rgb=records[:, 32:35].copy(),
        error=records[:, 35:43].copy().view("<f8")[:, 0].astype(np.float64),
    )


def _point_offsets(data: bytes, most: int) -> tuple[np.ndarray, int, int]:
    """Return where points begin in ``data``, what they take of it, and what one that is cut needs (0: none is)."""
    found: list[int] = []
    at, size, track_length = 0, len(data), struct.Struct("<Q").unpack_from
    while len(found) < most:
        end = at + 51
        if end <= size:
            end += 8 * track_length(data, at + 43)[0]
        if end > size:
            return np.array(found, dtype=np.int32), at, end - at
        found.append(at)
        at = end
    return np.array(found, dtype=np.int32), at, 0


def _lines(path: Path) -> list[tuple[int, str]]:
    """(line number, text) of all lines but comments; empty lines stay (an image without 2-D points has one)."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")  # names are as the file system has them
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
        if at < len(lines) and not _is_image(lines[at][1]):  # scripts leave out the empty lines of images without any
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
    """Return the image of its line (ValueError, IndexError)."""
    words = line.split(maxsplit=9)  # a name may hold spaces
    image_id, camera_id, name = int(words[0]), int(words[8]), words[9]
    pose = [parsed(word) for word in words[1:8]]
    return ColmapImage(image_id, camera_id, name, pose_matrix(pose[:4], pose[4:]))


def _is_image(line: str) -> bool:
    """Whether a line has nine numbers and a name. A line of 2-D points has numbers only."""
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
    """Floats as whole numbers; ValueError for NaN and what the type does not hold."""
    low, high = float(np.iinfo(dtype).min), float(np.iinfo(dtype).max)
    wrong = values[~((values >= low) & (values <= high) & (values < 2.0**63))]
    if wrong.size:
        raise ValueError(f"{wrong.flat[0]:g}, which is no {np.dtype(dtype).name}")
    return values.astype(dtype)


def pose_matrix(quat: list[float], translation: list[float]) -> np.ndarray:
    """T_cam_world [4, 4] of COLMAP's (w, x, y, z) and translation; NaN for NaN, infinity or a zero quaternion."""
    norm = math.sqrt(sum(q * q for q in quat))
    if not (math.isfinite(norm) and norm > 1e-8 and all(map(math.isfinite, translation))):
        return np.full((4, 4), np.nan)
    T = np.eye(4)
    T[:3, :3] = quats_to_matrices(torch.tensor([quat], dtype=torch.float64))[0].numpy()
    T[:3, 3] = translation
    return T


def _check_pose(image: ColmapImage, path: Path) -> None:
    if not np.isfinite(image.T_cam_world).all():
        raise UnusableViewError(f"{path}: image {image.name} must have a finite pose and a quaternion that is not zero")


# -- the scene ---------------------------------------------------------------------------------------------------------
MODEL_FOLDERS = ("sparse/0", "sparse", ".")


def model_folder(root: Path) -> tuple[Path, str] | None:
    """Find the model's folder and kind ("bin" or "txt"), or None.

    The largest of ``sparse/0``, ``sparse/1`` and so on, else ``sparse``, else ``root`` itself.
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
    """Return the sub-folders that hold a model, 2 before 10."""
    if not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if find_model(path)), key=lambda path: natural_key(path.name))


def _num_images(folder: Path) -> int:
    """Return the number of images of a model; 0 where its file is broken."""
    kind = find_model(folder) or "bin"
    path = _file(folder, "images", kind)
    try:
        if kind == "txt":
            return sum(1 for _ in _images_txt(path, observations=False))
        with _Bytes(path) as file:
            return file.count("images", _IMAGE_BYTES)
    except DataError:
        return 0


def read_colmap(root: Path, downscale: int) -> Capture:
    """Read a COLMAP data set.

    Photographs are in ``images`` beside ``sparse`` (also in sub-folders of it), or in ``images_N`` when ``downscale``
    is N and that folder exists. EXIF orientation is ignored, as COLMAP ignores it.

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
    images = list(_each_image(folder, kind, observations=False))
    home, photographs = _photographs(root, folder, kind, images)
    notes: list[str] = _other_models(folder)
    scaled = in_any_case(home, f"images_{downscale}")
    factor = 1
    if downscale > 1 and scaled.is_dir():
        smaller = _found(images, [scaled], _file(folder, "images", kind))
        if any(photo.path is not None for photo in smaller.values()):
            photographs, factor = smaller, downscale
            notes.append(f"photographs of 1/{downscale} size are read from {scaled.name}")
        else:
            notes.append(f"{scaled.name} holds none of the model's photographs and is not used")
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


def observed_points(folder: Path, kind: str, names: Mapping[str, str] | None = None) -> ObservedPoints:
    """Which points of a model each of its images was found to show.

    Parameters
    ----------
    folder : Path
    kind : str
    names : mapping of str to str, optional
        The views of the images, by name in the model; the same name if left out.

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
    for image in _each_image(folder, kind, observations=True):  # their observations are most of a model
        assert image.point_ids is not None
        ids = np.unique(image.point_ids[image.point_ids >= 0])
        at = order[np.searchsorted(points.ids, ids, sorter=order).clip(max=len(order) - 1)]
        rows = at[points.ids[at] == ids]
        seen[image.name if names is None else names.get(image.name, image.name)] = rows.astype(np.int32)
        track[rows] += 1
    return ObservedPoints(points.xyz, points.error, track, seen)


def model_points(folder: Path, kind: str) -> PointCloud | None:
    """Return the sparse points of a model as a PointCloud, or None."""
    points = read_points(folder, kind)
    return None if points is None or not len(points.xyz) else PointCloud(points.xyz, points.rgb)


def _intrinsics(path: Path, cameras: dict[int, ColmapCamera], image: ColmapImage) -> Intrinsics:
    camera = cameras.get(image.camera_id)
    if camera is None:
        raise DataError(
            f"{path} must hold camera {image.camera_id} of image {image.name}, got {sorted(cameras)[:9] or 'none'}; is "
            "the file complete? Copy or export it again"
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


def _photographs(root: Path, model: Path, kind: str, images: list[ColmapImage]) -> tuple[Path, dict[str, Photograph]]:
    """Return the folder that holds images, masks and sparse, and the photographs by name in the model."""
    homes = list(dict.fromkeys([root, model.parent, model.parent.parent]))
    listing = _file(model, "images", kind)
    for home in homes:
        if (at := in_any_case(home, "images")).is_dir():
            return home, _found(images, [at], listing)
    exact = (home for home in homes if any((home / image.name).is_file() for image in images))
    home = next(exact, root)  # folders above root are not searched
    photographs = _found(images, [home], listing)
    if any(photo.path is not None for photo in photographs.values()):
        return home, photographs
    raise DataError(
        f"{root} must have its photographs in the folder images, got no such folder; put the folder that COLMAP was "
        f"given there, under that name"
    )


def _found(images: list[ColmapImage], folders: list[Path], listing: Path) -> dict[str, Photograph]:
    reason = f"no such file in {folders[0].name}"
    return find_photographs([image.name for image in images], folders, listing, reason=reason)


def _other_models(folder: Path) -> list[str]:
    """Return a note with the sizes of the models beside the one that is read."""
    others = [path for path in _models_in(folder.parent) if path != folder] if is_number(folder.name) else []
    if not others:
        return []
    sizes = ", ".join(f"{path.name} has {_num_images(path)}" for path in others)
    return [
        f"the model {folder.parent.name}/{folder.name} is read, which has {_num_images(folder)} images; {sizes}. "
        f"Read another one by its folder: gs2d train {shlex.quote(str(others[0]))}"
    ]


def _check_factor(path: Path, k: Intrinsics, factor: int) -> None:
    """Check that a file in ``images_N`` is 1/N of its camera's size, up to rounding."""
    got, expected = np.array(image_size(path)), np.array((k.width, k.height)) / factor
    if (np.abs(got - expected) > np.maximum(1.0, 0.01 * expected)).any():
        raise DataError(
            f"{path} must be 1/{factor} of its camera's {k.width}x{k.height}, got {got[0]}x{got[1]}; "
            f"remove or rebuild the folder {path.parent.name}"
        )
