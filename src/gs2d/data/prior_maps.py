"""Depth and normal maps from files, resampled to the pixels of their image, and sparse points per image.

Values are never averaged across an edge or with unknown pixels. A map larger than the training image is reduced to the
median of the known values of each block; a smaller map is interpolated only where neighbours agree.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import minimum_filter

from gs2d.core.camera import Camera
from gs2d.data.arrays import read_npy
from gs2d.data.file_names import Files
from gs2d.data.image_files import image_size, read_grey, read_image
from gs2d.data.undistort import Intrinsics, source_positions
from gs2d.errors import DataError

DEPTHS, NORMALS = "depths", "normals"
DEPTH_SUFFIXES = (".npy", ".png", ".tif", ".tiff")
NORMAL_SUFFIXES = (".npy", ".png", ".jpg", ".jpeg", ".webp")
AGREE = 0.05  # largest relative difference of neighbours; more is an edge
UNIT_LENGTH = (0.8, 1.2)  # accepted lengths of normals
UNOBSERVED = "the capture does not say which points its images show"
MAX_PROJECTED = 100_000  # points; enough to align depths
HIDING_CELLS = 48  # cells along the longer image side for the occlusion test
HIDDEN = 1.25  # points beyond this multiple of the nearest depth in the same or a neighbouring cell are occluded
_ASPECT = 0.02  # relative tolerance: networks write sides that are multiples of 14 or 32


@dataclass(frozen=True, eq=False)
class PriorDepth:
    """Depths along the optical axis at the pixels of a view."""

    values: np.ndarray  # [H, W] float32; in the unit of the file; 0 = unknown
    whole: bool  # whether the file holds integers (mostly millimetres)


@dataclass(frozen=True, eq=False)
class PointsInView:
    """Sparse points in a view: ``pixels`` [M, 2] px and ``depth`` [M] world units along the optical axis."""

    pixels: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True, eq=False)
class ObservedPoints:
    """Sparse points of a reconstruction and the views that observe them."""

    points: np.ndarray  # [P, 3] float64 world units
    error: np.ndarray  # [P] float64 px; mean reprojection error
    track: np.ndarray  # [P] int64; number of views that observe the point
    by_view: Mapping[str, np.ndarray]  # view name to ndarray [M] int32 or int64; indices of the observed points
    # Why the capture has no observations; ``by_view`` then comes from projecting the points. Empty otherwise.
    guessed: str = ""

    @classmethod
    def projected(cls, points: np.ndarray | None, cameras: Mapping[str, Camera], why: str) -> ObservedPoints:
        """Guess the observations of points by projection and an occlusion test.

        ``points`` [P, 3] world units: at most ``MAX_PROJECTED``, evenly chosen, are assigned to views. ``why``: reason
        for ``guessed``.
        """
        points = np.zeros((0, 3)) if points is None else np.asarray(points, dtype=np.float64)
        some = np.arange(0, len(points), max(1, -(-len(points) // MAX_PROJECTED)), dtype=np.int32)
        by_view = {name: some[_unoccluded(points[some], camera)] for name, camera in cameras.items()}
        track = np.bincount(np.concatenate([*by_view.values(), some[:0]]), minlength=len(points))
        return cls(points, np.zeros(len(points)), track, by_view, why)

    def in_view(self, name: str, camera: Camera, *, min_track: int = 3, max_error: float = 2.0) -> PointsInView:
        """Return the points that a view observes, in front of it and inside its outer pixel centres.

        ``camera`` has the training size. ``min_track`` is the least number of views per point, ``max_error`` (px) the
        largest mean reprojection error.
        """
        rows = self.by_view.get(name, np.zeros(0, dtype=np.int64))
        return self._project(rows, camera, min_track, max_error)

    def inside(self, camera: Camera, *, min_track: int = 3, max_error: float = 2.0) -> PointsInView:
        """Return all points inside the image of a camera, as :meth:`in_view`, including occluded ones."""
        return self._project(np.arange(len(self.points)), camera, min_track, max_error)

    def _project(self, rows: np.ndarray, camera: Camera, min_track: int, max_error: float) -> PointsInView:
        xyz = self.points[rows[(self.track[rows] >= min_track) & (self.error[rows] <= max_error)]]
        pixels, depth = camera.project(xyz[np.isfinite(xyz).all(axis=1)])
        inside = (pixels >= 0.5).all(axis=1) & (pixels < (camera.width - 0.5, camera.height - 0.5)).all(axis=1)
        inside &= depth > 0
        return PointsInView(pixels[inside], depth[inside])


def _unoccluded(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return which points [P] bool lie in an image and not far behind another point of the same cell."""
    pixels, depth = camera.project(points)
    size = np.array((camera.width, camera.height))
    inside = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(axis=1)
    cells = np.floor(np.where(inside[:, None], pixels, 0) / (size.max() / HIDING_CELLS)).astype(np.int64)
    nearest = np.full((HIDING_CELLS, HIDING_CELLS), np.inf)
    np.minimum.at(nearest, (cells[inside, 1], cells[inside, 0]), depth[inside])
    around = minimum_filter(nearest, size=3, mode="nearest")
    return np.asarray(inside & (depth <= HIDDEN * around[cells[:, 1], cells[:, 0]]))


@dataclass(frozen=True)
class MapFiles:
    """Map files of an image."""

    depth: Path | None = None
    normal: Path | None = None
    unit: float | None = None  # world units per unit of depth, if the capture states it
    metric: bool = False  # whether the depths come from a sensor


@dataclass(frozen=True, eq=False)
class PriorMaps:
    """Maps of a view, decoded on demand."""

    files: MapFiles
    intrinsics: Intrinsics  # intrinsics of the image file, with its lens
    camera: Camera  # pinhole camera of the view, at training size

    def depth(self) -> PriorDepth:
        """Return the depth map at the pixels of the view.

        Raises DataError if the file is not a depth map, or its aspect ratio differs from the image.
        """
        assert self.files.depth is not None
        values = read_depth(self.files.depth)
        whole = bool(np.issubdtype(values.dtype, np.integer))
        valid = np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)
        _check_shape("depth map", self.files.depth, valid.shape, self.intrinsics)
        factor = max(1, valid.shape[1] // self.camera.width)
        positions = self._positions(valid.shape[1] / factor, valid.shape[0] / factor)
        return PriorDepth(sample(shrink(valid, factor), *positions), whole)

    def normal(self) -> np.ndarray:
        """Return unit normals [H, W, 3] float32 in the axes of the file; 0 = unknown.

        Raises DataError if the file is not a normal map, or its aspect ratio differs from the image.
        """
        assert self.files.normal is not None
        normals = read_normals(self.files.normal)
        _check_shape("normal map", self.files.normal, normals.shape[:2], self.intrinsics)
        factor = max(1, normals.shape[1] // self.camera.width)
        middle = factor // 2  # one value per block: averaging normals across an edge is wrong
        positions, valid = self._positions(normals.shape[1] / factor, normals.shape[0] / factor)
        normals = normals[middle::factor, middle::factor]
        rows, columns = _nearest(positions, normals.shape[:2])
        return np.asarray(np.where(valid[..., None], normals[rows, columns], 0), dtype=np.float32)

    def _positions(self, width: float, height: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels of the view in a map of this size: positions [H, W, 2] px, corner origin, and validity."""
        camera, k = self.camera, self.intrinsics
        smaller = Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, k.lens)
        if k.lens is None:
            x, y = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
            positions = np.stack(np.meshgrid(x, y), axis=-1)
            valid = np.ones(positions.shape[:2], dtype=bool)
        else:
            positions, valid = source_positions(smaller)
        # Image size at the scale of the view; fractional if downscaling cut rows.
        sides = np.array((k.width * camera.fx / k.fx, k.height * camera.fy / k.fy))
        return positions * (np.array((width, height)) / sides), valid


def find_maps(folder: Path, names: Sequence[str], suffixes: Sequence[str]) -> list[Path | None]:
    """Return the map of each image, or None: its name with the suffix replaced or appended."""
    spellings = [[word + s for s in suffixes for word in (os.path.splitext(name)[0], name)] for name in names]
    return [match.path for match in Files([folder]).match(spellings, moved=False)]


def read_depth(path: str | os.PathLike[str]) -> np.ndarray:
    """Read a depth map [h, w]: a grey image of 8, 16 or 32 bits, or a NumPy array.

    An image with three equal channels counts as grey. Raises DataError if the file is missing, not a depth map, or has
    no value above 0.
    """
    path = Path(path)
    if path.suffix == ".npy":
        values = read_npy(path, "depth map")
        values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
        values = values[0] if values.ndim == 3 and values.shape[0] == 1 else values
        if values.ndim != 2:
            raise DataError(f"depth map {path} must be an array [H, W], got {list(values.shape)}")
    else:
        size = image_size(path)  # raises for a file that is not an image
        values, mode = read_grey(path)
        if mode == "RGB" and values.ndim == 3 and (values == values[..., :1]).all():
            values = values[..., 0]
        if values.ndim != 2 or values.shape != (size[1], size[0]) or mode == "P":
            raise DataError(
                f"depth map {path} must be a grey image of 16 bits (or 8, or floats), or .npy, got one of mode {mode}; "
                "a colour-coded depth image cannot be used"
            )
    with np.errstate(invalid="ignore"):
        if not (np.isfinite(values) & (values > 0)).any():
            raise DataError(f"depth map {path} must hold depths above 0 (0 = unknown), got none; replace or remove it")
    return values


def read_normals(path: str | os.PathLike[str]) -> np.ndarray:
    """Read unit normals [h, w, 3] float32 from an RGB image of (n + 1) / 2 or an array of n; 0 = unknown.

    Black and transparent pixels and vectors of a length outside ``UNIT_LENGTH`` are unknown. Raises DataError if the
    file is missing, not a normal map, or has no valid normal.
    """
    path = Path(path)
    if path.suffix == ".npy":
        with np.errstate(over="ignore"):  # such values are not unit vectors
            normals = read_npy(path, "normal map").astype(np.float32)
        normals = normals.transpose(1, 2, 0) if normals.ndim == 3 and normals.shape[0] == 3 else normals
        if normals.ndim != 3 or normals.shape[2] != 3:
            raise DataError(f"normal map {path} must be an array [H, W, 3], got {list(normals.shape)}")
        opaque = np.asarray(np.isfinite(normals).all(axis=2))
        normals = np.where(opaque[..., None], normals, 0)
    else:
        image = read_image(path)
        normals = image[..., :3].astype(np.float32) / 127.5 - 1
        opaque = np.asarray(image[..., :3].any(axis=2) if image.shape[2] == 3 else image[..., 3] >= 128)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(normals, axis=2)
    valid = opaque & (length > UNIT_LENGTH[0]) & (length < UNIT_LENGTH[1])
    if not valid.any():
        raise DataError(f"normal map {path} must hold unit vectors n as (n + 1) / 2 (or n in .npy), got none")
    return np.asarray(np.where(valid, 1 / np.maximum(length, 1e-6), 0)[..., None] * normals, dtype=np.float32)


def _check_shape(what: str, path: Path, shape: tuple[int, ...], k: Intrinsics) -> None:
    """Check that a map has the aspect ratio of its image."""
    height, width = shape
    wrong = abs(width / height * k.height / k.width - 1)
    if wrong > max(_ASPECT, 1 / min(width, height)):
        raise DataError(
            f"{what} {path} must have the size or aspect ratio of its image, {k.width}x{k.height}, got "
            f"{width}x{height}; was it rotated, cropped or padded?"
        )


def shrink(values: np.ndarray, factor: int) -> np.ndarray:
    """Reduce [h, w] to [ceil(h / n), ceil(w / n)]: the lower median of the known values of each n x n block.

    0 if less than half of a block is known.
    """
    if factor <= 1:
        return values
    height, width = -(-values.shape[0] // factor), -(-values.shape[1] // factor)
    padded = np.zeros((height * factor, width * factor), values.dtype)
    padded[: values.shape[0], : values.shape[1]] = values
    blocks = padded.reshape(height, factor, width, factor).swapaxes(1, 2).reshape(height, width, factor**2)
    blocks = np.sort(np.where(blocks > 0, blocks, np.inf), axis=2)
    count = np.isfinite(blocks).sum(axis=2)
    middle = np.take_along_axis(blocks, np.maximum(count - 1, 0)[..., None] // 2, axis=2)[..., 0]
    return np.asarray(np.where(2 * count >= factor**2, middle, 0), dtype=values.dtype)


def sample(values: np.ndarray, positions: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Sample a map [h, w] at ``positions`` [H, W, 2] px, corner origin; 0 if unknown or not ``valid``.

    Bilinear if the four neighbours are known and agree within ``AGREE``, else nearest.
    """
    height, width = values.shape
    rows, columns = _nearest(positions, (height, width))
    nearest = values[rows, columns]
    at = positions - 0.5
    left = np.clip(np.floor(at[..., 0]), 0, max(width - 2, 0)).astype(np.int64)
    top = np.clip(np.floor(at[..., 1]), 0, max(height - 2, 0)).astype(np.int64)
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = np.clip(at[..., 0] - left, 0, 1), np.clip(at[..., 1] - top, 0, 1)
    four = np.stack([values[top, left], values[top, right], values[below, left], values[below, right]])
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    least, most = four.min(axis=0), four.max(axis=0)
    smooth = (least > 0) & (most - least <= AGREE * most)
    sampled = np.where(smooth, (four * weights).sum(axis=0), nearest)
    return np.where(valid, sampled, 0).astype(np.float32)


def _nearest(positions: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the pixels that contain the positions."""
    columns = np.clip(np.floor(positions[..., 0]), 0, shape[1] - 1).astype(np.int64)
    rows = np.clip(np.floor(positions[..., 1]), 0, shape[0] - 1).astype(np.int64)
    return rows, columns
