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
from gs2d.core.image_arrays import composite, enlarged
from gs2d.core.memory import trim
from gs2d.data.cache import DecodedImage, ImageCache
from gs2d.data.masks import Masks
from gs2d.data.prior_maps import UNOBSERVED, ObservedPoints, PriorMaps
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError

Appearance = Mapping[str, np.ndarray]
"""Learned parameters of a view, by the name of the quantity."""


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """An image with its camera, decoded on demand."""

    name: str  # unique in its scene: file path relative to the image folder, with ``/`` (``cam0/0001.jpg``)
    camera: Camera  # pinhole camera of ``image()``, after undistortion and downscaling
    decode: Callable[[], DecodedImage] = field(repr=False)  # decodes the image from disk; called through the cache
    cache: ImageCache = field(repr=False, default_factory=lambda: ImageCache(0))  # shared by all views of a scene
    path: Path | None = None  # image file
    maps: PriorMaps | None = None  # depth and normal maps
    # Intrinsics of the image file, before undistortion and downscaling; None: as ``camera``.
    intrinsics: Intrinsics | None = None
    zoom: Zoom | None = None  # learned change of the intrinsics of ``camera``; None: unchanged
    # Learned parameters of how the image shows the colours of the scene (``gs2d.training.learned``).
    appearance: Appearance = field(default_factory=dict)
    # Maps of training, in cells [S, S]: transient (bool) is what no other image shows, and does not count; shine
    # (uint8) is 0 on matt surface, 255 on shiny surface.
    transient: np.ndarray | None = None
    shine: np.ndarray | None = None
    # The panorama or wide fisheye that it was cut out of (``data/faces.py``), as in its file: not undistorted, with the
    # lens in ``intrinsics``. All faces of a photograph share it.
    whole: View | None = field(default=None, repr=False)

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
        """Make a view from arrays: image uint8 [H, W, 3 or 4], masks bool [H, W]."""
        if valid is not None:
            mask = valid if mask is None else mask & valid
        decoded = DecodedImage(image, mask, object_mask, valid)
        return cls(name, camera, lambda: decoded)

    def at(self, T_cam_world: np.ndarray, zoom: Zoom | None = None) -> View:
        """Return the view with another pose, and other intrinsics; its image stays in the cache of this view."""
        camera = replace(self.camera, T_cam_world=T_cam_world)
        return self._sharing(camera=camera) if zoom is None else self._sharing(camera=camera.zoomed(zoom), zoom=zoom)

    def with_cells(self, **maps: np.ndarray) -> View:
        """Return the view with its ``transient`` or ``shine``, unless they are 0 everywhere."""
        found = {name: cells for name, cells in maps.items() if cells.any()}
        return self._sharing(**found) if found else self

    def with_appearance(self, appearance: Appearance) -> View:
        """Return the view with further appearance parameters."""
        return self._sharing(appearance={**self.appearance, **appearance})

    def _sharing(self, **changes: Any) -> View:
        """Return a changed view whose image stays in the cache of this view."""
        return replace(self, decode=self._image, cache=ImageCache(0), **changes)

    def file_intrinsics(self) -> Intrinsics:
        """Return the intrinsics of the image file, including its lens."""
        c = self.camera
        return self.intrinsics or Intrinsics(c.width, c.height, c.fx, c.fy, c.cx, c.cy)

    def image(self) -> np.ndarray:
        """Return the image, uint8 [H, W, 3] or [H, W, 4] with straight alpha; read-only.

        Raises DataError if the file does not decode or no longer exists.
        """
        return self._image().image

    def mask(self) -> np.ndarray | None:
        """Return the mask of used pixels, bool [H, W] (a copy); None: all are used."""
        return self._without_transient(self._image().mask)

    def _without_transient(self, mask: np.ndarray | None) -> np.ndarray | None:
        if self.transient is None:
            return None if mask is None else mask.copy()
        kept: np.ndarray = ~enlarged(self.transient, self.camera.height, self.camera.width)
        return kept if mask is None else kept & mask

    def valid(self) -> np.ndarray | None:
        """Return the mask of valid pixels, bool [H, W] (a copy); None: all are valid.

        Pixels that undistortion takes from outside the photograph are invalid. They are black in ``image()`` and never
        trained, scored or shown, whether or not a protocol uses masks.
        """
        valid = self._image().valid
        return None if valid is None else valid.copy()

    def usable(self, *, masks: bool) -> np.ndarray | None:
        """Return the pixels that training and scores use, bool [H, W]; None: all.

        If the protocol uses masks: ``mask()``, which excludes invalid pixels too; else ``valid()`` without transients.
        """
        image = self._image()
        return self._without_transient(image.mask if masks else image.valid)

    def object_mask(self) -> np.ndarray | None:
        """Return the silhouette of the object, bool [H, W] (a copy): from a file, else alpha >= 0.5, else None.

        It limits the surface, not the pixels that are trained: the background of DTU is trained and then left out of
        the mesh.
        """
        image = self._image()
        if image.object_mask is not None:
            return image.object_mask.copy()
        return image.image[:, :, 3] >= 128 if image.image.shape[2] == 4 else None

    def alpha(self) -> np.ndarray | None:
        """Return the alpha channel, float32 [H, W] in [0, 1]; None without one."""
        image = self._image().image
        return np.divide(image[:, :, 3], np.float32(255), dtype=np.float32) if image.shape[2] == 4 else None

    def target(self, background: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the image over ``background`` (3 floats in [0, 1]), float32 [H, W, 3] in [0, 1]."""
        return composite(self._image().image, background)

    def _image(self) -> DecodedImage:
        return self.cache.get(self, self._decode_checked)

    def _decode_checked(self) -> DecodedImage:
        image = self.decode()
        expected = (self.camera.height, self.camera.width)
        masks = {"mask": image.mask, "object mask": image.object_mask, "mask of valid pixels": image.valid}
        for what, array in {"image": image.image, **masks}.items():
            if array is not None and array.shape[:2] != expected:
                raise DataError(
                    f"the {what} of view {self.name} must be {expected[1]}x{expected[0]} like its camera, "
                    f"got {array.shape[1]}x{array.shape[0]}; did the file change since the scene was loaded?"
                )
        return image


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Sparse points."""

    points: np.ndarray  # [P, 3] float64 world units
    colors: np.ndarray | None = None  # [P, 3] uint8 sRGB
    normals: np.ndarray | None = None  # [P, 3]; unit surface normals of either sign; 0 = unknown
    # [P] float64 world units; standard deviations of the initial splats; 0: from the distance of neighbouring points
    sizes: np.ndarray | None = None

    def __post_init__(self) -> None:
        shapes = {"points": "P 3", "colors": "P 3", "normals": "P 3", "sizes": "P"}
        arrays = {name: (getattr(self, name), shape) for name, shape in shapes.items()}
        check_shapes({name: pair for name, pair in arrays.items() if pair[0] is not None})

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Scene:
    """A capture in its own coordinates: never re-centred, never rescaled.

    Attributes
    ----------
    name : str
        Name of the folder.
    format : str
        One of ``gs2d.data.FORMATS``.
    train, test : tuple of View
        Sorted by name. ``test`` may be empty.
    points : PointCloud or None
        Sparse points.
    extent : float, world units
        1.1 x the largest distance of a training camera from their mean (> 0).
    bounds : ndarray [2, 3] float64, world units
        Corners of the box that the cameras look at.
    T_metric_scene : ndarray [4, 4] float64
        x_metric = T_metric_scene @ x_scene, for evaluation (DTU: millimetres).
    skipped : tuple of str
        Listed views that could not be used, one sentence each.
    notes : tuple of str
        Decisions of loading that the user should know, one sentence each.
    details : tuple of str
        Routine decisions of loading, one sentence each.
    root : Path or None
        Folder of the capture.
    observe : callable or None
        Reads which sparse points each image observes; :meth:`observed` calls it.
    ahead : int
        Number of images to read ahead, because not all stay in memory; 0: all do.
    masks : Masks
        Masks of the images and their meaning.
    own_split : bool
        Whether the capture defines its test views, so that ``test_every`` does not apply.
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
        """Return the scene with other poses and intrinsics. Images are shared.

        Parameters
        ----------
        poses : mapping
            T_cam_world [4, 4] by name of the training view.
        zooms : mapping
            Change of intrinsics by name of the view, training or test.
        """

        def moved(view: View, pose: np.ndarray | None) -> View:
            zoom = zooms.get(view.name)
            if pose is None and zoom is None:
                return view
            return view.at(view.camera.T_cam_world if pose is None else pose, zoom)

        train = tuple(moved(view, poses.get(view.name)) for view in self.train)
        return replace(self, train=train, test=tuple(moved(view, None) for view in self.test))

    def with_appearance(self, by_name: Mapping[str, Appearance]) -> Scene:
        """Return the scene with appearance parameters, by name of the view."""

        def updated(views: tuple[View, ...]) -> tuple[View, ...]:
            return tuple(view.with_appearance(by_name[view.name]) if view.name in by_name else view for view in views)

        return replace(self, train=updated(self.train), test=updated(self.test))

    @property
    def views(self) -> tuple[View, ...]:
        """All views: training views, then test views."""
        return self.train + self.test

    def observed(self, *, guessed: bool = True) -> ObservedPoints | None:
        """Return which sparse points each image observes; None if unknown.

        Parameters
        ----------
        guessed : bool
            Whether to accept observations that were guessed by projecting the points.
        """
        if self.observe is None or (self.unobserved() and not guessed):
            return None
        try:
            observed = self.observe()
        except DataError:  # from a third-party reader
            return None
        return observed if any(map(len, observed.by_view.values())) else None

    def unobserved(self) -> str:
        """Return why the capture has no observations of points; "" if it has."""
        try:
            return UNOBSERVED if self.observe is None else self.observe().guessed
        except DataError as error:
            return str(error)

    def forget(self) -> None:
        """Drop decoded images and observations from memory; they are read again when needed."""
        for cache in {id(view.cache): view.cache for view in self.views}.values():
            cache.clear()
        clear = getattr(self.observe, "cache_clear", None)  # of functools.cache
        if clear is not None:
            clear()

    def preload(self, threads: int = 2) -> Iterator[View]:
        """Decode every image once, yielding each view.

        Fills the cache and detects invalid files before training.

        Raises
        ------
        DataError
            For the first image (in order of ``views``) that does not decode.
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
