"""A posed capture: views, sparse points and where they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from gs2d.core.camera import Camera, Zoom
from gs2d.core.checks import check_shapes
from gs2d.core.images import composite
from gs2d.core.memory import trim
from gs2d.data.cache import DecodedImage, ImageCache
from gs2d.data.masks import Masks
from gs2d.data.priors import UNOBSERVED, ObservedPoints, PriorMaps
from gs2d.data.straighten import straightened_picture
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError

Appearance = Mapping[str, np.ndarray]
"""Numbers of a view by the name of the quantity."""


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """One posed photograph, decoded when asked for.

    Attributes
    ----------
    name : str
        Unique in its scene: the file's path relative to the image folder, with ``/`` (``cam0/0001.jpg``).
    camera : Camera
        Pinhole, at the size that ``image()`` has (downscaling and undistortion are already in it).
    decode : callable
        Reads the picture from disk; called through the cache.
    cache : ImageCache
        Shared by all views of a scene.
    path : Path or None
        The photograph's file.
    maps : PriorMaps or None
        Its depth and normal maps, where the capture has such.
    intrinsics : Intrinsics or None
        Of the photograph's file, before its lens was taken out and before it was shrunk; None: as ``camera``.
    zoom : Zoom or None
        What training has made of the intrinsics of ``camera`` since they were read; None: nothing.
    appearance : mapping of name to ndarray
        What training has learned of how the photograph shows the colours of the scene: numbers of each quantity
        (``gs2d.training.learned``).
    is_face : bool
        Whether it was cut out of a panorama or a wide fisheye (``data/faces.py``): its axis is not that of a lens.
    """

    name: str
    camera: Camera
    decode: Callable[[], DecodedImage] = field(repr=False)
    cache: ImageCache = field(repr=False, default_factory=lambda: ImageCache(0))
    path: Path | None = None
    maps: PriorMaps | None = None
    intrinsics: Intrinsics | None = None
    zoom: Zoom | None = None
    appearance: Appearance = field(default_factory=dict)
    is_face: bool = False

    @classmethod
    def from_arrays(
        cls,
        name: str,
        camera: Camera,
        image: np.ndarray,
        mask: np.ndarray | None = None,
        object_mask: np.ndarray | None = None,
        valid: np.ndarray | None = None,
    ) -> View:
        """Return a view of arrays in memory: image uint8 [H, W, 3 or 4], masks bool [H, W]."""
        if valid is not None:
            mask = valid if mask is None else mask & valid
        picture = DecodedImage(image, mask, object_mask, valid)
        return cls(name, camera, lambda: picture)

    def at(self, T_cam_world: np.ndarray, zoom: Zoom | None = None) -> View:
        """Return the same photograph, taken from elsewhere; its picture stays in the cache of this one.

        With ``zoom`` its camera gets other intrinsics, too, and its picture is straightened each time it is asked for,
        where that says that something of the lens is left.
        """
        camera = replace(self.camera, T_cam_world=T_cam_world)
        if zoom is None:
            return self._sharing(camera=camera)
        now, lens = camera.zoomed(zoom), zoom.lens
        seen = self._sharing(camera=now, zoom=zoom)
        if lens is None:
            return seen
        return replace(seen, decode=lambda: straightened_picture(self._image(), now, lens))

    def with_appearance(self, found: Appearance) -> View:
        """Return the same photograph, with more that is known of how it shows colours."""
        return self._sharing(appearance={**self.appearance, **found})

    def _sharing(self, **changes: Any) -> View:
        """Return a view with other facts whose picture stays in the cache of this one."""
        return replace(self, decode=self._image, cache=ImageCache(0), **changes)

    def downscaled(self, factor: int) -> View:
        """Return the same photograph at 1 / ``factor`` of its size, with its camera, masks and maps.

        Its picture is made of that of this view each time it is asked for: nothing is held twice.
        """
        if factor == 1:
            return self
        camera = self.camera.downscaled(factor)
        maps = None if self.maps is None else replace(self.maps, camera=camera)
        small = self._sharing(camera=camera, maps=maps)
        return replace(small, decode=lambda: self._image().downscaled(factor))

    def file_intrinsics(self) -> Intrinsics:
        """Return the intrinsics of the photograph's file, lens and all."""
        c = self.camera
        return self.intrinsics or Intrinsics(c.width, c.height, c.fx, c.fy, c.cx, c.cy)

    def image(self) -> np.ndarray:
        """Return the photograph, uint8 [H, W, 3] or [H, W, 4] with straight alpha; read-only.

        Raises
        ------
        DataError
            The file does not decode, or is gone.
        """
        return self._image().image

    def mask(self) -> np.ndarray | None:
        """Which pixels count, bool [H, W] (a fresh copy), or None if all do. False = ignore this pixel."""
        mask = self._image().mask
        return None if mask is None else mask.copy()

    def valid(self) -> np.ndarray | None:
        """Return where the photograph says anything, bool [H, W] (a fresh copy), or None if everywhere.

        False where undistortion reaches beyond the photograph: there ``image()`` is black, and nobody may learn it,
        score it or show it, whatever a protocol makes of masks.
        """
        valid = self._image().valid
        return None if valid is None else valid.copy()

    def usable(self, *, masks: bool) -> np.ndarray | None:
        """Return which pixels count where a protocol uses masks or does not, bool [H, W], or None if all do.

        Parameters
        ----------
        masks : bool
            True: ``mask()``, which leaves out unknown pixels too; False: ``valid()``.
        """
        return self.mask() if masks else self.valid()

    def object_mask(self) -> np.ndarray | None:
        """Where the object is, bool [H, W] (a fresh copy): a silhouette file (DTU), else alpha >= 0.5, else None.

        Unlike ``mask`` it says nothing about which pixels to train on: the background of DTU is trained and then
        left out of the surface.
        """
        image = self._image()
        if image.object_mask is not None:
            return image.object_mask.copy()
        return image.image[:, :, 3] >= 128 if image.image.shape[2] == 4 else None

    def alpha(self) -> np.ndarray | None:
        """Return the alpha channel, float32 [H, W] in [0, 1], or None if the photograph has none."""
        image = self._image().image
        return np.divide(image[:, :, 3], np.float32(255), dtype=np.float32) if image.shape[2] == 4 else None

    def target(self, background: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the target of a rendering over ``background`` (3 floats in [0, 1]), float32 [H, W, 3] in [0, 1]."""
        return composite(self._image().image, background)

    def _image(self) -> DecodedImage:
        return self.cache.get(self, self._decode_checked)

    def _decode_checked(self) -> DecodedImage:
        image = self.decode()
        expected = (self.camera.height, self.camera.width)
        masks = {"mask": image.mask, "object mask": image.object_mask, "mask of known pixels": image.valid}
        for what, array in {"image": image.image, **masks}.items():
            if array is not None and array.shape[:2] != expected:
                raise DataError(
                    f"the {what} of view {self.name} must be {expected[1]}x{expected[0]} like its camera, "
                    f"got {array.shape[1]}x{array.shape[0]}; did the file change since the scene was loaded?"
                )
        return image


def _or(value: np.ndarray | None, otherwise: np.ndarray) -> np.ndarray:
    return otherwise if value is None else value


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Sparse points.

    Attributes
    ----------
    points : ndarray [P, 3] float64 world units
    colors : ndarray [P, 3] uint8 sRGB, or None
    normals : ndarray [P, 3] or None
        Of the surface, unit, either way round; 0 where unknown.
    sizes : ndarray [P] float64 world units, or None
        Standard deviations of the splats that start there; 0: as large as the points around leave room for.
    """

    points: np.ndarray
    colors: np.ndarray | None = None
    normals: np.ndarray | None = None
    sizes: np.ndarray | None = None

    def __post_init__(self) -> None:
        shapes = {"points": (self.points, "P 3")}
        if self.colors is not None:
            shapes["colors"] = (self.colors, "P 3")
        if self.normals is not None:
            shapes["normals"] = (self.normals, "P 3")
        if self.sizes is not None:
            shapes["sizes"] = (self.sizes, "P")
        check_shapes(shapes)

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Scene:
    """A capture as it is on disk: never re-centred, never rescaled.

    Attributes
    ----------
    name : str
        The folder's name.
    format : str
        One of ``gs2d.data.FORMATS``.
    train, test : tuple of View
        Sorted by name. ``test`` is empty where all views train.
    points : PointCloud or None
        Sparse points to start from.
    extent : float, world units
        1.1 x the largest distance of a training camera from the mean of all of them (> 0).
    bounds : ndarray [2, 3] float64, world units
        Smallest and largest corner of the box that the cameras look at.
    T_metric_scene : ndarray [4, 4] float64
        x_metric = T_metric_scene @ x_scene; for evaluation only (DTU: millimetres).
    skipped : tuple of str
        Views that are listed but could not be used, one sentence each, for the user to see.
    notes : tuple of str
        What loading decided that the user may have to act on, one sentence each.
    details : tuple of str
        Routine decisions of loading, one sentence each.
    root : Path or None
        The folder it came from.
    observe : callable or None
        Reads which sparse points each photograph was found to show; :meth:`observed` calls it.
    ahead : int
        Pictures that whoever goes through the views asks for before they are needed, because they come from the disk
        each time (``gs2d.data.prepared``); 0: they are to stay in memory.
    masks : Masks
        Which of the photographs have a mask, and what it means.
    own_split : bool
        Whether the capture itself says which views are test views, so that ``test_every`` does not apply.
    """

    name: str
    format: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: PointCloud | None
    extent: float
    bounds: np.ndarray
    T_metric_scene: np.ndarray = field(default_factory=lambda: np.eye(4))
    skipped: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    details: tuple[str, ...] = ()
    root: Path | None = None
    observe: Callable[[], ObservedPoints] | None = None
    ahead: int = 0
    masks: Masks = Masks()  # noqa: RUF009 (frozen)
    own_split: bool = False

    def with_poses(self, poses: Mapping[str, np.ndarray], zooms: Mapping[str, Zoom] = MappingProxyType({})) -> Scene:
        """Return the scene with other cameras. Images are shared.

        Parameters
        ----------
        poses : mapping
            T_cam_world [4, 4] by the name of a training view.
        zooms : mapping
            What becomes of the intrinsics of a view, training or test, by its name.
        """

        def moved(view: View, pose: np.ndarray | None) -> View:
            zoom = zooms.get(view.name)
            return view if pose is None and zoom is None else view.at(_or(pose, view.camera.T_cam_world), zoom)

        train = tuple(moved(view, poses.get(view.name)) for view in self.train)
        return replace(self, train=train, test=tuple(moved(view, None) for view in self.test))

    def with_appearance(self, found: Mapping[str, Appearance]) -> Scene:
        """Return the scene with what is known of how its photographs show colours, by the name of the view."""

        def seen(views: tuple[View, ...]) -> tuple[View, ...]:
            return tuple(view.with_appearance(found[view.name]) if view.name in found else view for view in views)

        return replace(self, train=seen(self.train), test=seen(self.test))

    def downscaled(self, factor: int) -> Scene:
        """Return the scene with training photographs of 1 / ``factor`` of their size; test views stay as they are."""
        return self if factor == 1 else replace(self, train=tuple(view.downscaled(factor) for view in self.train))

    @property
    def views(self) -> tuple[View, ...]:
        """Training views, then test views."""
        return self.train + self.test

    def observed(self, *, guessed: bool = True) -> ObservedPoints | None:
        """Return which sparse points each photograph shows, or None where that is not known.

        Parameters
        ----------
        guessed : bool
            Whether points that were projected, because the capture does not say it, count.
        """
        if self.observe is None or (self.unobserved() and not guessed):
            return None
        try:
            found = self.observe()
        except DataError:  # of a reader that is not ours
            return None
        return found if any(map(len, found.seen.values())) else None

    def unobserved(self) -> str:
        """Return why the capture does not say which points its photographs show; "" where it does."""
        try:
            return UNOBSERVED if self.observe is None else self.observe().guessed
        except DataError as error:
            return str(error)

    def forget(self) -> None:
        """Drop decoded pictures and which points they show from memory; whoever asks for one has it read again."""
        for cache in {id(view.cache): view.cache for view in self.views}.values():
            cache.clear()
        clear = getattr(self.observe, "cache_clear", None)  # of functools.cache
        if clear is not None:
            clear()

    def preload(self, threads: int = 2) -> Iterator[View]:
        """Decode every picture once, yielding each view when its picture is good.

        Fills the cache as far as its bound allows, and finds broken files before hours of training do.

        Raises
        ------
        DataError
            The first picture (in order of ``views``) that does not decode.
        """

        def decode(view: View) -> View:
            view.image()
            return view

        with ThreadPoolExecutor(max_workers=max(1, threads)) as pool:
            try:
                yield from pool.map(decode, self.views)
            finally:
                pool.shutdown(cancel_futures=True)
                trim()
