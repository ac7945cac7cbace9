"""Captures as readers return them, and their conversion to a Scene."""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gs2d.core.camera import Camera
from gs2d.core.transforms import camera_extent, camera_outliers
from gs2d.data.bounds import scene_bounds
from gs2d.data.cache import AHEAD, DecodedImage, ImageCache
from gs2d.data.camera_models import model_of
from gs2d.data.faces import GLANCE, LEAST_SHOWN, Face, face_name, face_positions, faces_of, wrapped
from gs2d.data.file_names import in_any_case
from gs2d.data.image_files import image_size, read_image, read_mask
from gs2d.data.masks import EMPTY, Masks, find_masks
from gs2d.data.prior_maps import (
    DEPTH_SUFFIXES,
    DEPTHS,
    NORMAL_SUFFIXES,
    NORMALS,
    UNOBSERVED,
    MapFiles,
    ObservedPoints,
    PriorMaps,
    find_maps,
)
from gs2d.data.scene import PointCloud, Scene, View
from gs2d.data.undistort import Intrinsics, source_positions, undistort_image, undistort_mask
from gs2d.errors import DataError, ShapeError, UnusableViewError

# The image size may differ from the camera's by a factor; each axis may then be off by rounding.
_ASPECT_TOLERANCE = 0.01
_LARGEST_SIDE = 1 << 31  # px, of a camera

_LENSES = (0.01, 1e5)  # focal length / side: fields of view from 178.9 degrees down to 2 arc seconds

# Largest float32 spacing of positions, relative to the extent: warning, error. Training moves splats by 1e-6.
_COARSE, _TOO_COARSE = 1e-5, 1e-3
_FARTHEST = 1e12  # world units from the origin; its cube is still a float32 number


@dataclass(frozen=True, eq=False, slots=True)
class PosedImage:
    """An image file with its camera."""

    name: str  # unique, with ``/``
    path: Path
    intrinsics: Intrinsics  # for the image size that the capture states
    T_cam_world: np.ndarray  # [4, 4]
    split: str | None = None  # "train", "test"; None: the capture has no split
    # mask, object_mask: image files; white = used, white = object
    mask: Path | None = None
    object_mask: Path | None = None
    # Use the alpha channel as the object mask and keep the image opaque, because the background is real (DTU as 2DGS
    # ships it).
    alpha_is_silhouette: bool = False
    maps: MapFiles | None = None  # depth and normal maps
    mask_is_alpha: bool = False  # use the mask as the alpha channel: masked pixels are empty
    # Pinhole face of a wide image. ``name`` and ``T_cam_world`` are those of the face, ``path`` and ``intrinsics``
    # those of the image.
    face: Face | None = None
    undistorts: bool = True  # False: the image stays as in its file


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture as its reader returns it; further attributes are as in Scene."""

    format: str
    frames: tuple[PosedImage, ...]
    points: PointCloud | None = None
    T_metric_scene: np.ndarray = field(default_factory=lambda: np.eye(4))
    default_test_every: int = 8
    downscaled_by: int = 1  # factor by which the image files are already downscaled (``images_N``)
    skipped: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    home: Path | None = None  # folder that may hold folders of maps and masks, if it is not the root
    observe: Callable[[], ObservedPoints] | None = None  # reads which sparse points each image observes
    mask_homes: tuple[Path, ...] = ()  # further folders that may hold masks
    finds_masks: bool = True  # False if files with the usual names of masks are something else
    is_synthetic: bool = False  # try the box [-1.3, 1.3]^3 of NeRF-Synthetic; it is used if the cameras agree with it


def decode(frame: PosedImage, downscale: int) -> DecodedImage:
    """Decode, undistort and downscale an image and its masks."""
    k = frame.intrinsics
    image = read_image(frame.path)
    if image.shape[:2] != (k.height, k.width):
        raise DataError(
            f"image {frame.path} must be {k.width}x{k.height}, got {image.shape[1]}x{image.shape[0]}; "
            "did the file change since the scene was loaded?"
        )
    mask = _sized_mask(frame.mask, k, need=0.5 if frame.mask_is_alpha else 1.0)
    object_mask = _sized_mask(frame.object_mask, k, need=0.5)
    if frame.alpha_is_silhouette and image.shape[2] == 4:
        object_mask = image[:, :, 3] >= 128 if object_mask is None else object_mask
        image = image[:, :, :3]
    if frame.mask_is_alpha:
        if mask is not None and object_mask is not None:
            object_mask = object_mask & mask
        image, mask = cut_out(image, mask), None
    valid = None
    if k.lens is not None and frame.undistorts:
        positions, inside = source_positions(k) if frame.face is None else face_positions(k, frame.face)
        image = wrapped(image, k)
        mask, object_mask = (None if a is None else wrapped(a, k) for a in (mask, object_mask))
        valid = inside
        image = undistort_image(image, positions, inside)
        mask = None if mask is None else inside & undistort_mask(mask, positions, need=1.0)
        if object_mask is not None:
            object_mask = inside & undistort_mask(object_mask, positions, need=0.5)
    small = DecodedImage(image, mask, object_mask, valid).downscaled(downscale)
    mask, valid = (None if pixels is None or pixels.all() else pixels for pixels in (small.mask, small.valid))
    image = np.ascontiguousarray(small.image)
    return DecodedImage(image, valid if mask is None else mask, small.object_mask, valid)


def _sized_mask(path: Path | None, k: Intrinsics, need: float) -> np.ndarray | None:
    """Return a mask at image size: True where at least ``need`` of the pixel area is white."""
    if path is None:
        return None
    mask = read_mask(path)
    if mask.shape == (k.height, k.width):
        return mask
    # A mask of another size (full-size masks beside images_4); its aspect ratio was checked at load.
    grey = Image.fromarray(mask.astype(np.uint8) * np.uint8(255))
    return np.asarray(grey.resize((k.width, k.height), Image.Resampling.BOX)) >= 255 * need


@contextmanager
def skipping(name: str, skipped: list[str]) -> Iterator[None]:
    """Catch UnusableViewError and add image and reason to ``skipped``."""
    try:
        yield
    except UnusableViewError as error:
        skipped.append(f"{name}: {error}")


def fit_to_file(frame: PosedImage) -> PosedImage:
    """Return the frame with intrinsics for the actual size of its file.

    Raises DataError if the file is not an image, or its aspect ratio or that of a mask differs.
    """
    k = frame.intrinsics
    width, height = image_size(frame.path)
    if (width, height) != (k.width, k.height):
        if max(k.width, k.height) > _LARGEST_SIDE:  # double precision is exhausted
            raise DataError(
                f"image {frame.path} must have a camera of its size, {width}x{height}, got one with more than "
                f"{_LARGEST_SIDE:,} pixels per side; is the camera file complete?"
            )
        _check_aspect(f"image {frame.path}", (width, height), (k.width, k.height), "camera")
        k = k.scaled(width, height)
    for path in (frame.mask, frame.object_mask):
        if path is not None and image_size(path) != (width, height):
            _check_aspect(f"mask {path}", image_size(path), (width, height), "image")
    return replace(frame, intrinsics=k)


def _check_aspect(what: str, size: tuple[int, int], expected: tuple[int, int], owner: str) -> None:
    sx, sy = size[0] / expected[0], size[1] / expected[1]
    # Allow one pixel of rounding on either axis.
    if abs(sx / sy - 1) > max(_ASPECT_TOLERANCE, 1 / min(size), 1 / min(expected)):
        raise DataError(
            f"{what} must have the size or aspect ratio of its {owner}, {expected[0]}x{expected[1]}, "
            f"got {size[0]}x{size[1]}; was it rotated or cropped after calibration?"
        )


def cut_out(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return an image [H, W, 3 or 4] with an alpha channel that is 0 where a mask [H, W] bool is False."""
    alpha = np.full(image.shape[:2], 255, np.uint8) if image.shape[2] == 3 else image[:, :, 3].copy()
    if mask is not None:
        alpha[~mask] = 0
    return np.dstack([image[:, :, :3], alpha])


def build_scene(
    capture: Capture,
    root: Path,
    *,
    downscale: int,
    test_every: int | None,
    cache_bytes: int,
    masks: Masks = Masks(),  # noqa: B008 (frozen)
) -> Scene:
    """Convert a Capture to a Scene: check sizes, downscale cameras, split views, measure extent and bounds.

    Raises DataError if there is no training view, a name occurs twice, or all cameras have the same centre.
    """
    if not capture.frames:
        raise DataError(f"{root} must contain at least one image with a camera, got none{_explained(capture)}")
    if downscale < 1 or (test_every is not None and test_every < 0):
        raise DataError(f"downscale must be >= 1 and test_every >= 0, got {downscale} and {test_every}")
    factor = max(1, downscale // capture.downscaled_by)
    cache = ImageCache(cache_bytes, spills=True)
    frames, mask_notes, masks = _with_masks(capture, root, masks)
    frames = sorted((fit_to_file(frame) for frame in frames), key=lambda frame: frame.name)
    photographs = frames
    frames, cut = _cut(frames)
    names = [frame.name for frame in frames]
    if len(set(names)) != len(names):
        twice = next(a for a, b in itertools.pairwise(names) if a == b)
        raise DataError(f"{root} has several views named {twice}; names must be unique")
    frames, map_notes = (frames, ()) if cut else _with_maps(frames, capture.home or root)
    wholes = {each.path: _view(replace(each, undistorts=False, maps=None), factor, cache) for each in photographs}
    views = [_view(frame, factor, cache, wholes[frame.path] if frame.face else None) for frame in frames]
    outliers = camera_outliers([view.camera for view in views])
    try:
        train, test = _split(frames, views, capture.default_test_every, test_every, root, set(outliers))
        cameras = [view.camera for view in train]
        extent, place_notes = _measured_extent(cameras, root)
    except DataError as error:
        raise DataError(f"{error}{_explained(capture)}") from error
    points, point_notes = _finite_points(capture.points)
    decoded = 3 * sum(view.camera.width * view.camera.height for view in (*train, *test))  # bytes
    bounds, bound_notes = scene_bounds(cameras, points, is_synthetic=capture.is_synthetic)
    return Scene(
        name=root.resolve().name,
        format=capture.format,
        train=train,
        test=test,
        points=points,
        extent=extent,
        bounds=bounds,
        T_metric_scene=capture.T_metric_scene,
        skipped=tuple(
            f"{names[i]} is left out: its camera is {ratio:,.4g} times as far from the median camera centre "
            "as the median camera, so its pose is wrong"
            for i, ratio in outliers.items()
        )
        + capture.skipped,
        notes=capture.notes + mask_notes + cut + map_notes + place_notes + point_notes + bound_notes,
        details=_lens_notes(frames),
        root=root,
        ahead=AHEAD if decoded > cache_bytes else 0,
        masks=masks,
        own_split=any(frame.split for frame in frames),
        observe=_observed(capture, frames, points, {view.name: view.camera for view in (*train, *test)}),
    )


def _explained(capture: Capture) -> str:
    """Return the notes of the reader, for the end of an error message; "" without any."""
    skipped = f"{len(capture.skipped)} skipped, first: {capture.skipped[0]}" if capture.skipped else ""
    notes = [*capture.notes, *([skipped] if skipped else [])]
    return f" ({'; '.join(notes)})" if notes else ""


def _measured_extent(cameras: Sequence[Camera], root: Path) -> tuple[float, tuple[str, ...]]:
    """Return the extent, world units, and a warning if float32 positions are coarse this far from the origin.

    Raises DataError if all cameras have the same centre, or float32 positions are too coarse for the scene.
    """
    farthest = max(float(np.abs(camera.center).max()) for camera in cameras)
    if not farthest <= _FARTHEST:
        raise DataError(
            f"{root} must have its cameras within {_FARTHEST:g} units of the origin, got one at {farthest:.4g}; "
            "move or scale the poses, or remove that view"
        )
    extent = camera_extent(cameras)
    if not extent > 1e-9 * (1 + farthest):
        raise DataError(
            f"{root} must have training cameras with different centres, got {len(cameras)} with the same centre: "
            "reconstruction needs a baseline"
        )
    step = farthest * float(np.finfo(np.float32).eps)  # float32 spacing
    if step <= _COARSE * extent:
        return extent, ()
    what = f"32-bit positions have a spacing of {step:.2g} near the cameras, {farthest:.4g} units from the origin"
    if step > _TOO_COARSE * extent:
        raise DataError(
            f"{root} is too far from the origin: {what}, for a scene of extent {extent:.4g}; subtract an offset "
            "from the poses and points (map coordinates have a large one)"
        )
    return extent, (f"{what}: fine detail is lost; subtract an offset from the poses and points",)


def _view(frame: PosedImage, factor: int, cache: ImageCache, whole: View | None = None) -> View:
    k = frame.intrinsics
    if not all(_LENSES[0] <= f / side <= _LENSES[1] for f, side in ((k.fx, k.width), (k.fy, k.height))):
        raise DataError(
            f"view {frame.name}: expected a focal length of {_LENSES[0]:g} to {_LENSES[1]:g} times the image side, "
            f"got {k.fx:.4g}, {k.fy:.4g} px for {k.width}x{k.height} px; is it in pixels?"
        )
    ideal = k if frame.face is None else frame.face.intrinsics
    try:
        camera = Camera(ideal.width, ideal.height, ideal.fx, ideal.fy, ideal.cx, ideal.cy, frame.T_cam_world)
        camera = camera.downscaled(factor)
    except ShapeError as error:
        raise DataError(f"view {frame.name}: {error}") from error
    maps = None if frame.maps is None else PriorMaps(frame.maps, k, camera)
    read = functools.partial(decode, frame, factor)
    return View(frame.name, camera, read, cache, frame.path, maps, ideal, whole=whole)


def _cut(frames: Sequence[PosedImage]) -> tuple[list[PosedImage], tuple[str, ...]]:
    """Split panoramas and wide fisheyes into pinhole faces; returns the frames and a note."""
    faces = {k: faces_of(k) for k in dict.fromkeys(frame.intrinsics for frame in frames)}
    split_frames: list[PosedImage] = []
    kinds: dict[str, int] = {}
    shown: dict[Any, bool] = {}
    for frame in frames:
        lens, parts = frame.intrinsics.lens, faces[frame.intrinsics]
        if lens is None or not parts:
            split_frames.append(frame)
            continue
        kinds[lens.kind] = kinds.get(lens.kind, 0) + 1
        for face in parts:
            if not _shows_enough(frame, face, shown):
                continue
            T = frame.T_cam_world.copy()
            T[:3] = face.rotation @ T[:3]
            split_frames.append(replace(frame, name=face_name(frame.name, face), T_cam_world=T, face=face, maps=None))
    if not kinds:
        return list(frames), ()
    what = " and ".join(f"{count} {kind} photographs" for kind, count in kinds.items())
    number = sum(frame.face is not None for frame in split_frames)
    maps = any(frame.maps is not None for frame in frames)
    note = f"{what} are cut into {number} pinhole faces of 90 degrees, so that nothing is lost"
    return split_frames, (note + ("; their depth and normal maps are not used" if maps else ""),)


def _shows_enough(frame: PosedImage, face: Face, cache: dict[Any, bool]) -> bool:
    """Whether the mask of a fisheye leaves enough of a face.

    ``cache`` holds earlier results: the images of a camera mostly share one mask.
    """
    k = frame.intrinsics
    if frame.mask is None or frame.mask_is_alpha or k.lens is None or model_of(k.lens).wraps:
        return True
    key = (k, face.name, hashlib.sha256(frame.mask.read_bytes()).digest())
    if key not in cache:
        mask = read_mask(frame.mask)
        positions, valid = face_positions(k, replace(face, side=GLANCE))
        u, v = (positions * (mask.shape[1] / k.width, mask.shape[0] / k.height)).astype(int).reshape(-1, 2).T
        visible = valid & mask[v.clip(max=len(mask) - 1), u.clip(max=mask.shape[1] - 1)].reshape(valid.shape)
        cache[key] = bool(visible.mean() >= LEAST_SHOWN)
    return cache[key]


def _observed(
    capture: Capture, frames: Sequence[PosedImage], points: PointCloud | None, cameras: Mapping[str, Camera]
) -> Callable[[], ObservedPoints] | None:
    """Return a function that reads which points the views observe; faces get the points of their image.

    Without valid observations, the points are projected into the views.
    """
    if capture.observe is None and points is None:
        return None
    wholes = {frame.path: frame.name for frame in capture.frames}
    parts = [frame for frame in frames if frame.face is not None]

    def read() -> ObservedPoints:
        observed, why = None, UNOBSERVED
        if capture.observe is not None:
            try:
                observed = capture.observe()
            except DataError as error:
                why = str(error)
        if observed is None or not any(map(len, observed.by_view.values())):
            return ObservedPoints.projected(None if points is None else points.points, cameras, why)
        by_view = dict(observed.by_view)
        for part in parts:
            if (rows := observed.by_view.get(wholes[part.path])) is not None:
                x, y, z = part.T_cam_world[:3, :3] @ observed.points[rows].T + part.T_cam_world[:3, 3:]
                by_view[part.name] = rows[np.maximum(abs(x), abs(y)) < z]
        return replace(observed, by_view=by_view)

    return functools.cache(read)  # called for every view


def _with_masks(capture: Capture, root: Path, masks: Masks) -> tuple[list[PosedImage], tuple[str, ...], Masks]:
    """Return the frames with their masks, a note, and the masks with their count."""
    frames = list(capture.frames)
    if not capture.finds_masks and masks.folder is None:
        note = (
            f"masks: --masked {masks.masked} has no effect: format {capture.format} has silhouettes, which only limit "
            "the surface (--masks DIR sets masks)"
        )
        return frames, (note,) if masks.masked is not None else (), masks
    homes = [home for home in (capture.home, *capture.mask_homes, root) if home is not None]
    named, names, images = ([getattr(frame, what) for frame in frames] for what in ("mask", "name", "path"))
    paths, note = find_masks(names, images, named, homes, masks)
    count = len(paths) - paths.count(None)
    empty = masks.masked == EMPTY and count > 0
    frames = [replace(frame, mask=mask, mask_is_alpha=empty) for frame, mask in zip(frames, paths, strict=True)]
    return frames, (note,) if note else (), replace(masks, found=count)


def _with_maps(frames: list[PosedImage], home: Path) -> tuple[list[PosedImage], tuple[str, ...]]:
    """Return the frames with their maps in ``depths`` and ``normals``, and a note per folder."""
    notes = []
    for what, folder, suffixes in (("depth", DEPTHS, DEPTH_SUFFIXES), ("normal", NORMALS, NORMAL_SUFFIXES)):
        if not (at := in_any_case(home, folder)).is_dir():
            continue
        paths = find_maps(at, [frame.name for frame in frames], suffixes)
        for index, path in enumerate(paths):
            maps = frames[index].maps or MapFiles()
            if path is not None and getattr(maps, what) is None:
                change: dict[str, Any] = {what: path}
                frames[index] = replace(frames[index], maps=replace(maps, **change))
        count = len(paths) - paths.count(None)
        notes.append(f"{what} maps: {count} of {len(frames)} views have one in {what}s (--{what}-prior uses them)")
    return frames, tuple(notes)


def _split(
    frames: list[PosedImage],
    views: list[View],
    default_every: int,
    test_every: int | None,
    root: Path,
    outliers: set[int],
) -> tuple[tuple[View, ...], tuple[View, ...]]:
    if any(frame.split for frame in frames):
        is_test = [frame.split == "test" for frame in frames]
    else:
        every = default_every if test_every is None else test_every
        wholes = [frame.name if frame.face is None else str(frame.path) for frame in frames]
        numbers = {whole: number for number, whole in enumerate(dict.fromkeys(wholes))}  # faces stay together
        is_test = [bool(every) and numbers[whole] % every == 0 for whole in wholes]
    train, test = (  # outliers do not change the other test views
        tuple(view for i, view in enumerate(views) if is_test[i] == held_out and i not in outliers)
        for held_out in (False, True)
    )
    if not train:
        raise DataError(f"{root} must have a training view, got only {len(test)} test views; use test_every=0")
    return train, test


def _finite_points(points: PointCloud | None) -> tuple[PointCloud | None, tuple[str, ...]]:
    if points is None or not len(points):
        return None, ()
    finite = np.isfinite(points.points).all(axis=1)
    if finite.all():
        return points, ()
    note = f"{int((~finite).sum())} of {len(points)} sparse points are NaN or infinite and were left out"
    if not finite.any():
        return None, (note,)
    return PointCloud(points.points[finite], None if points.colors is None else points.colors[finite]), (note,)


def _lens_notes(frames: list[PosedImage]) -> tuple[str, ...]:
    frames = [frame for frame in frames if frame.face is None]
    lenses = {frame.intrinsics for frame in frames if frame.intrinsics.lens is not None}
    if not lenses:
        return ()
    kinds = sorted({k.lens.kind for k in lenses if k.lens is not None})
    bent = sum(frame.intrinsics.lens is not None for frame in frames)
    wide = max(math.degrees(2 * math.atan(max(k.width / k.fx, k.height / k.fy) / 2)) for k in lenses)
    return (
        f"{bent} of {len(frames)} views are undistorted on load ({' and '.join(kinds)} lenses, to pinhole images of "
        f"{wide:.0f} degrees)",
    )
