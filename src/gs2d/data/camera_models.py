"""Camera models: where the lens of a photograph shows the rays of its camera.

Training uses pinhole images. A photograph of any other camera is resampled when it is read: into the pinhole
image of its own focal length (:mod:`gs2d.data.undistort`), or, if it sees more than such an image holds, into the faces
of a cube (:mod:`gs2d.data.faces`). Both need one function of the camera model: from rays to points of the sensor.

Rays (X, Y, Z) are in the camera frame (x right, y down, z forward). Points (x', y') are in focal lengths from the
principal point: pixel = (fx x' + cx, fy y' + cy). With x = X/Z, y = Y/Z, r^2 = x^2 + y^2, t the angle of a ray from the
axis, n and d the radial coefficients and p the tangential ones (OpenCV and COLMAP use the same):

perspective      s = (1 + n1 r^2 + n2 r^4 + ...) / (1 + d1 r^2 + d2 r^4 + ...)
                 x' = x s + 2 p1 x y + p2 (r^2 + 2 x^2),   y' = y s + 2 p2 x y + p1 (r^2 + 2 y^2)
fisheye          (x', y') = (x, y) t (1 + n1 t^2 + n2 t^4 + ...) / r, plus the tangential terms above of
                 (x, y) t / r (Metashape, OpenSfM's fisheye62), and those of a thin prism: s1 t^2, s2 t^2
fov              (x', y') = (x, y) atan(2 r tan(w/2)) / (w r)
equirectangular  (x', y') = (atan2(X, Z), atan2(Y, sqrt(X^2 + Z^2)))

A sensor whose axes are not at right angles (Metashape's b2) shears the result: x' + skew y'.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from gs2d.config.registry import Register, Registry
from gs2d.core.transforms import perpendicular
from gs2d.errors import DataError

PANORAMA = "equirectangular"
_SMALLEST = 1e-12  # radius, so that nothing is divided by 0
# Newton's method: rays it may start from, steps, the difference for slopes, the longest step (radians), and the error
# of a result (focal lengths).
_SPHERE, _STEPS, _SMALL, _REACH, _CLOSE = 20_000, 8, 1e-6, 0.1, 1e-7


@dataclass(frozen=True)
class Lens:
    """The parameters of a camera model besides focal lengths and principal point."""

    kind: str  # name of the camera model: "perspective", "fisheye", "fov", "equirectangular" or a registered one
    radial: tuple[float, ...] = ()  # n1, n2, ... ("fov": the angle w). A registered model has its own parameters here.
    divisor: tuple[float, ...] = ()  # d1, d2, ... ("perspective").
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2 ("perspective" and "fisheye")
    skew: float = 0.0  # shear of the sensor, in units of fx
    prism: tuple[float, float] = (0.0, 0.0)  # s1, s2 ("fisheye")

    @property
    def is_identity(self) -> bool:
        """Whether the lens distorts nothing, so that its photographs are pinhole images."""
        return not self.skew and model_of(self).is_identity(self)

    def project(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points [..., 2] of rays [..., 3], in focal lengths, and which rays the lens shows [...] bool."""
        with np.errstate(all="ignore"):  # beyond what the lens shows
            points, shown = model_of(self).project(self, rays)
        if self.skew:
            points = points + self.skew * points[..., 1:] * (1.0, 0.0)
        return points, shown

    def unproject(self, points: np.ndarray) -> np.ndarray:
        """Return the unit rays [..., 3] of points [..., 2] in focal lengths; 0 where the lens shows none."""
        points = points - self.skew * points[..., 1:] * (1.0, 0.0)
        return model_of(self).unproject(replace(self, skew=0.0), points)

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Return where ideal points [..., 2] of the plane z = 1 are on the sensor [..., 2], in focal lengths."""
        return self.project(np.concatenate([points, np.ones_like(points[..., :1])], axis=-1))[0]


class CameraModel:
    """Base class of camera models. A class is registered; it is created without arguments."""

    # Keys of ``transforms.json`` that fill ``Lens.radial``, for frames whose ``camera_model`` is the registered name.
    parameters: tuple[str, ...] = ()
    is_wide: bool = False  # whether photographs of more than 120 degrees are cut into faces
    wraps: bool = False  # whether the left edge of a photograph continues at its right edge

    def project(self, lens: Lens, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points [..., 2] of rays [..., 3], in focal lengths, and which rays the lens shows [...] bool."""
        raise NotImplementedError

    def unproject(self, lens: Lens, points: np.ndarray) -> np.ndarray:
        """Return the unit rays [..., 3] of points [..., 2] in focal lengths; 0 where the lens shows none.

        This is Newton's method for ``project``, which starts from the nearest of many rays whose points are known.
        Models whose inverse is a formula override it.
        """
        z = np.arange(1 - _SPHERE, _SPHERE, 2) / _SPHERE  # a spiral on the sphere, without its poles
        turn, across = np.arange(_SPHERE) * math.pi * (3 - math.sqrt(5)), np.sqrt(1 - z * z)
        known = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1)
        at, shown = lens.project(known)
        rays = known[shown][cKDTree(at[shown]).query(points)[1]]
        for _ in range(_STEPS):
            axes = perpendicular(torch.from_numpy(rays)).numpy()  # [..., 2, 3]
            at, moved = lens.project(rays)[0], lens.project(rays[..., None, :] + _SMALL * axes)[0]
            slopes = np.moveaxis((moved - at[..., None, :]) / _SMALL, (-2, -1), (0, 1))  # [2 axes, 2 coordinates, ...]
            (a, c), (b, d), (x, y) = slopes[0], slopes[1], np.moveaxis(points - at, -1, 0)
            with np.errstate(all="ignore"):
                steps = np.stack([d * x - b * y, a * y - c * x], axis=-1) / (a * d - b * c)[..., None]
            rays = rays + (np.nan_to_num(steps).clip(-_REACH, _REACH)[..., None] * axes).sum(axis=-2)
            rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        at, shown = lens.project(rays)
        return np.where((shown & (np.abs(at - points).max(axis=-1) < _CLOSE))[..., None], rays, 0.0)

    def is_identity(self, lens: Lens) -> bool:
        """Whether a lens with these parameters distorts nothing."""
        return False


CAMERA_MODELS: Registry[Callable[[], CameraModel]] = Registry(
    "camera_model",
    "gs2d.camera_models",
    builtin=dict.fromkeys(("perspective", "fisheye", "fov", PANORAMA), __name__),
    error=DataError,
)
"""Names of camera models -> their classes."""


def register_camera_model(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers a camera model, for ``Lens.kind`` and ``camera_model`` in ``transforms.json``.

    Parameters
    ----------
    name : str
        Must not be taken.

    Returns
    -------
    callable
        Decorates a subclass of ``gs2d.data.camera_models.CameraModel``.

    Examples
    --------
    >>> import gs2d, numpy as np
    >>> from gs2d.data.camera_models import CameraModel
    >>> @gs2d.register_camera_model("orthographic-fisheye")
    ... class Orthographic(CameraModel):
    ...     is_wide = True
    ...     def project(self, lens, rays):
    ...         unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    ...         return unit[..., :2], unit[..., 2] > 0
    """
    return CAMERA_MODELS.register(name)


def model_of(lens: Lens) -> CameraModel:
    """Return the camera model of a lens."""
    return CAMERA_MODELS.get(lens.kind)()


class _Radial(CameraModel):
    """A lens that scales the points of the plane z = 1 by a function of their radius."""

    def scale(self, lens: Lens, r: np.ndarray) -> np.ndarray:
        """Return the factor by which points at ideal radii ``r`` are scaled."""
        raise NotImplementedError

    def project(self, lens: Lens, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points of rays; a lens shows those in front of it, up to where its polynomial folds back."""
        x, y, z = rays[..., 0], rays[..., 1], rays[..., 2]
        x, y = x / z, y / z
        r2 = x * x + y * y
        scale = self.scale(lens, np.sqrt(r2))
        p1, p2 = lens.tangential
        u = x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * scale + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        return np.stack([u, v], axis=-1), (z > 0) & (np.hypot(x, y) < _largest_radius(lens))


@register_camera_model("perspective")
class Perspective(_Radial):
    """The lens of OpenCV: radial and tangential distortion of a pinhole image."""

    def scale(self, lens: Lens, r: np.ndarray) -> np.ndarray:
        """Return the ratio of two polynomials."""
        r2 = r * r
        return np.asarray(_polynomial(lens.radial, r2) / _polynomial(lens.divisor, r2))

    def is_identity(self, lens: Lens) -> bool:
        """Whether all coefficients are 0."""
        return not (any(lens.radial) or any(lens.divisor) or any(lens.tangential))


@register_camera_model("fov")
class Fov(_Radial):
    """The lens of Devernay and Faugeras, with one parameter."""

    def scale(self, lens: Lens, r: np.ndarray) -> np.ndarray:
        """Return the ratio of the angle to the radius."""
        safe, w = np.maximum(r, _SMALLEST), lens.radial[0]
        return np.asarray(np.arctan(2 * safe * math.tan(w / 2)) / (w * safe))

    def is_identity(self, lens: Lens) -> bool:
        """Whether the angle is 0."""
        return abs(lens.radial[0]) < 1e-9


@register_camera_model("fisheye")
class Fisheye(CameraModel):
    """A lens whose radius is a polynomial of the angle from its axis, which may exceed 90 degrees."""

    is_wide = True

    def project(self, lens: Lens, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points of rays; a lens shows those up to the angle at which its polynomial folds back."""
        x, y, z = rays[..., 0], rays[..., 1], rays[..., 2]
        across = np.maximum(np.sqrt(x * x + y * y), _SMALLEST)
        t = np.arctan2(across, z)
        return _fisheye_points(lens, rays[..., :2] / across[..., None], t), t < _last_angle(lens)


@register_camera_model(PANORAMA)
class Equirectangular(CameraModel):
    """A panorama: columns are longitudes, rows are latitudes."""

    is_wide, wraps = True, True

    def project(self, lens: Lens, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return longitude and latitude."""
        x, y, z = rays[..., 0], rays[..., 1], rays[..., 2]
        return np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=-1), np.ones(x.shape, dtype=bool)

    def unproject(self, lens: Lens, points: np.ndarray) -> np.ndarray:
        """Return the rays of longitudes and latitudes."""
        x, y = points[..., 0], points[..., 1]
        return np.stack([np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)], axis=-1)


def _fisheye_points(lens: Lens, directions: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the points of rays at angles ``t`` [...] from the axis, in unit directions [..., 2] from it."""
    x, y = directions[..., 0], directions[..., 1]
    reach = t * _polynomial(lens.radial, t * t)
    u, v = x * reach, y * reach
    p1, p2 = lens.tangential
    if p1 or p2 or any(lens.prism):
        x, y, t2 = x * t, y * t, t**2
        u = u + 2 * p1 * x * y + p2 * (t2 + 2 * x * x) + lens.prism[0] * t2
        v = v + 2 * p2 * x * y + p1 * (t2 + 2 * y * y) + lens.prism[1] * t2
    return np.stack([u, v], axis=-1)


@functools.lru_cache(maxsize=64)
def _last_angle(lens: Lens) -> float:
    """Return the angle in radians up to which the radius of a fisheye grows; beyond it the polynomial folds back."""
    t = np.linspace(0.0, math.pi, 4000)
    reach = _fisheye_points(lens, np.stack([np.ones_like(t), 0 * t], axis=-1), t)[:, 0]
    falls = np.flatnonzero(~(np.diff(reach) > 0))
    return float(t[falls[0]]) if len(falls) else math.pi


@functools.lru_cache(maxsize=64)
def _largest_radius(lens: Lens) -> float:
    """Return the ideal radius up to which the radial mapping grows; beyond it the polynomial folds back."""
    model = model_of(lens)
    assert isinstance(model, _Radial)
    # A field of view of 175 degrees is more than any pinhole image holds.
    grid = np.tan(np.linspace(0.0, math.radians(87.5), 2000))
    with np.errstate(all="ignore"):
        values = grid * model.scale(lens, grid)
    falls = np.flatnonzero(~(np.diff(values) > 0))
    if not len(falls):
        return math.inf
    low, high = float(grid[max(falls[0] - 1, 0)]), float(grid[falls[0] + 1])

    def slope(r: float) -> float:
        h = 1e-6 * max(r, 1e-3)
        inner, outer = np.array([max(r - h, 0.0), r + h]) * model.scale(lens, np.array([max(r - h, 0.0), r + h]))
        return float((outer - inner) / h)

    return brentq(slope, low, high) if slope(low) > 0 > slope(high) else low


def _polynomial(coefficients: tuple[float, ...], x: np.ndarray) -> np.ndarray:
    """Return 1 + c1 x + c2 x^2 + ..."""
    value = np.zeros_like(x)
    for coefficient in reversed(coefficients):
        value = (value + coefficient) * x
    return np.asarray(value + 1.0)
