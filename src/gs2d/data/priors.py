"""Depth and normal maps of photographs from files, brought to the photographs' pixels; sparse points by photograph.

A pixel of a map is one reading of a sensor or a network: readings are never averaged across an edge, nor with pixels
of which nothing is known. Where a map is larger than the photograph in training, a block of it becomes the middle one
of its known readings; where it is smaller, neighbours are interpolated only if they agree.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import minimum_filter

from gs2d.core.camera import Camera
from gs2d.data.arrays import read_npy
from gs2d.data.file_names import Files
from gs2d.data.image_files import image_size, read_grey, read_image
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError

DEPTHS, NORMALS = "depths", "normals"
DEPTH_SUFFIXES = (".npy", ".png", ".tif", ".tiff", ".exr")
NORMAL_SUFFIXES = (".npy", ".png", ".jpg", ".jpeg", ".webp")
AGREE = 0.05  # neighbours that differ by more, as a share of the largest, are an edge
UNIT_LENGTH = (0.8, 1.2)  # a normal of another length is none
UNOBSERVED = "the capture does not say which points its images show"
MAX_PROJECTED = 100_000  # points: more would not tell more of depths
HIDING_CELLS = 48  # along the longer side of an image, in which points hide those behind them
HIDDEN = 1.25  # times the depth of a point in the same or a neighbouring cell, behind which others are hidden
_ASPECT = 0.02  # maps of networks have sides that are multiples of 14 or 32

LensMaps = Callable[[Intrinsics], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class PriorDepth:
    """Depths along the optical axis at the pixels of a photograph, as they were stored.

    Attributes
    ----------
    values : ndarray [H, W] float32
        In the file's unit; 0 where unknown.
    whole : bool
        The file holds whole numbers (millimetres, mostly).
    """

    values: np.ndarray
    whole: bool


@dataclass(frozen=True, eq=False)
class PointsInView:
    """Sparse points in a picture: ``pixels`` [M, 2] px and ``depth`` [M] world units along the optical axis."""

    pixels: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True, eq=False)
class ObservedPoints:
    """The sparse points of a reconstruction, and which photographs they were found in.

    Attributes
    ----------
    points : ndarray [P, 3] float64 world units
    error : ndarray [P] float64 px
        Mean reprojection error.
    track : ndarray [P] int64
        Photographs in which it was found.
    seen : mapping of view name to ndarray [M] int32 or int64
        Rows of the points found in a view.
    guessed : str
        Why the capture does not say in which photographs its points were found; ``seen`` is then a guess, made by
        projecting them. Empty where it does.
    """

    points: np.ndarray
    error: np.ndarray
    track: np.ndarray
    seen: Mapping[str, np.ndarray]
    guessed: str = ""

    @classmethod
    def projected(cls, points: np.ndarray | None, cameras: Mapping[str, Camera], why: str) -> ObservedPoints:
        """Return points with the views in whose images they lie, as far as no other point hides them there.

        Parameters
        ----------
        points : ndarray [P, 3] world units, or None
            Of many, some are taken, evenly; the others are in no view.
        cameras : mapping of view name to Camera
        why : str
            Reason for ``guessed``.
        """
        points = np.zeros((0, 3)) if points is None else np.asarray(points, dtype=np.float64)
        some = np.arange(0, len(points), max(1, -(-len(points) // MAX_PROJECTED)), dtype=np.int32)
        seen = {name: some[_unhidden(points[some], camera)] for name, camera in cameras.items()}
        track = np.bincount(np.concatenate([*seen.values(), some[:0]]), minlength=len(points))
        return cls(points, np.zeros(len(points)), track, seen, why)

    def in_view(self, name: str, camera: Camera, *, min_track: int = 3, max_error: float = 2.0) -> PointsInView:
        """Return the points found in one view, inside its outer pixel centres and in front of it.

        Parameters
        ----------
        name : str
            Of the view.
        camera : Camera
            Of the view, at the size that its pictures have.
        min_track : int
            Points found in fewer photographs are left out.
        max_error : float, px
            Points with a larger mean reprojection error are left out.
        """
        rows = self.seen.get(name, np.zeros(0, dtype=np.int64))
        return self._project(rows, camera, min_track, max_error)

    def inside(self, camera: Camera, *, min_track: int = 3, max_error: float = 2.0) -> PointsInView:
        """Return all points that lie in a camera's picture, as :meth:`in_view`, also those that something hides."""
        return self._project(np.arange(len(self.points)), camera, min_track, max_error)

    def _project(self, rows: np.ndarray, camera: Camera, min_track: int, max_error: float) -> PointsInView:
        xyz = self.points[rows[(self.track[rows] >= min_track) & (self.error[rows] <= max_error)]]
        pixels, depth = camera.project(xyz[np.isfinite(xyz).all(axis=1)])
        inside = (pixels >= 0.5).all(axis=1) & (pixels < (camera.width - 0.5, camera.height - 0.5)).all(axis=1)
        inside &= depth > 0
        return PointsInView(pixels[inside], depth[inside])


def _unhidden(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return which points [P] bool lie in an image and not far behind another point in the same part of it."""
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
    """The maps that a photograph has.

    Attributes
    ----------
    depth, normal : Path or None
    unit : float or None
        world units of a depth of 1 in the file, where the capture says so.
    metric : bool
        The capture says that its depths are a sensor's.
    """

    depth: Path | None = None
    normal: Path | None = None
    unit: float | None = None
    metric: bool = False


@dataclass(frozen=True, eq=False)
class PriorMaps:
    """The maps of one view, decoded when asked for.

    Attributes
    ----------
    files : MapFiles
    intrinsics : Intrinsics
        Of the photograph's file, with its lens.
    camera : Camera
        Of the view: pinhole, at the size in training.
    lens_maps : callable
        ``undistort.source_positions``, with a cache.
    """

    files: MapFiles
    intrinsics: Intrinsics
    camera: Camera
    lens_maps: LensMaps

    def depth(self) -> PriorDepth:
        """Return the depth map at the view's pixels.

        Raises
        ------
        DataError
            The file is no depth map, or of another shape than its photograph.
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
        """Return normals [H, W, 3] float32 in the axes of the file, unit length; 0 where unknown.

        Raises
        ------
        DataError
            The file is no normal map, or of another shape than its photograph.
        """
        assert self.files.normal is not None
        normals = read_normals(self.files.normal)
        _check_shape("normal map", self.files.normal, normals.shape[:2], self.intrinsics)
        factor = max(1, normals.shape[1] // self.camera.width)
        middle = factor // 2  # one reading of a block: the mean of normals on both sides of an edge is neither
        positions, valid = self._positions(normals.shape[1] / factor, normals.shape[0] / factor)
        normals = normals[middle::factor, middle::factor]
        rows, columns = _nearest(positions, normals.shape[:2])
        return np.asarray(np.where(valid[..., None], normals[rows, columns], 0), dtype=np.float32)

    def _positions(self, width: float, height: float) -> tuple[np.ndarray, np.ndarray]:
        """Where the view's pixels are in a map of this size: positions [H, W, 2] px, corner origin, and validity."""
        camera, k = self.camera, self.intrinsics
        smaller = Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, k.lens)
        if k.lens is None:
            x, y = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
            positions = np.stack(np.meshgrid(x, y), axis=-1)
            valid = np.ones(positions.shape[:2], dtype=bool)
        else:
            positions, valid = self.lens_maps(smaller)
        # The photograph at the view's scale has k.width fx / k.fx pixels: a fraction where rows were cut.
        sides = np.array((k.width * camera.fx / k.fx, k.height * camera.fy / k.fy))
        return positions * (np.array((width, height)) / sides), valid


def find_maps(folder: Path, names: Sequence[str], suffixes: Sequence[str]) -> list[Path | None]:
    """Return the map of each photograph: its name with one of the suffixes for its own, or after it; None without."""
    spellings = [[word + s for s in suffixes for word in (os.path.splitext(name)[0], name)] for name in names]
    return [match.path for match in Files([folder]).match(spellings, moved=False)]


def read_depth(path: str | os.PathLike[str]) -> np.ndarray:
    """Return the numbers of a depth map [h, w]: a grey image of 8, 16 or 32 bits, or an array of numpy.

    An image of three channels that are alike is grey, too: networks write such.

    Raises
    ------
    DataError
        Missing, no such file, or no number above 0 in it.
    """
    path = Path(path)
    if path.suffix == ".npy":
        values = read_npy(path, "depth map")
        values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
        values = values[0] if values.ndim == 3 and values.shape[0] == 1 else values
        if values.ndim != 2:
            raise DataError(f"depth map {path} must be an array [H, W], got {list(values.shape)}")
    else:
        size = image_size(path)  # a file that is no image is named here
        values, mode = read_grey(path)
        if mode == "RGB" and values.ndim == 3 and (values == values[..., :1]).all():
            values = values[..., 0]
        if values.ndim != 2 or values.shape != (size[1], size[0]) or mode == "P":
            raise DataError(
                f"depth map {path} must be a grey image of 16 bits (or 8, or floats), or .npy, got one of mode {mode}; "
                "a coloured picture of depths holds no depths"
            )
    with np.errstate(invalid="ignore"):
        if not (np.isfinite(values) & (values > 0)).any():
            raise DataError(f"depth map {path} must hold depths above 0 (0 = unknown), got none; replace or remove it")
    return values


def read_normals(path: str | os.PathLike[str]) -> np.ndarray:
    """Return unit normals [h, w, 3] float32 of a map, 0 where unknown: an RGB image of (n + 1) / 2, or an array of n.

    Black, transparent, and what is no unit vector by a fifth, is unknown.

    Raises
    ------
    DataError
        Missing, no such file, or no normal in it.
    """
    path = Path(path)
    if path.suffix == ".npy":
        with np.errstate(over="ignore"):  # what is beyond float32 is no unit vector
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
    """Check that a map has the aspect of its photograph."""
    height, width = shape
    wrong = abs(width / height * k.height / k.width - 1)
    if wrong > max(_ASPECT, 1 / min(width, height)):
        raise DataError(
            f"{what} {path} must have the size (or aspect) of its photograph, {k.width}x{k.height}, got "
            f"{width}x{height}; was it rotated, cropped or padded?"
        )


def shrink(values: np.ndarray, factor: int) -> np.ndarray:
    """[h, w] to [ceil(h / n), ceil(w / n)]: the middle (lower) one of the known readings of each n x n block.

    0 where less than half of a block is known.
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
    """Return a map [h, w] at ``positions`` [H, W, 2] px, corner origin; 0 where unknown or not ``valid``.

    Bilinear where the four readings around are known and agree within ``AGREE``, else the nearest one.
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
    found = np.where(smooth, (four * weights).sum(axis=0), nearest)
    return np.where(valid, found, 0).astype(np.float32)


def _nearest(positions: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that hold the positions."""
    columns = np.clip(np.floor(positions[..., 0]), 0, shape[1] - 1).astype(np.int64)
    rows = np.clip(np.floor(positions[..., 1]), 0, shape[0] - 1).astype(np.int64)
    return rows, columns
