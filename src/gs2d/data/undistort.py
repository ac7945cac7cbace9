"""Lens distortion and its removal.

Points are on the plane z = 1 of the camera: (x, y) = (X/Z, Y/Z), r^2 = x^2 + y^2. A lens maps the ideal point (x, y)
to the point that the sensor saw; fx, fy, cx, cy then map both to pixels. With n, d the radial coefficients and p the
tangential ones (OpenCV and COLMAP write them the same way):

perspective  s = (1 + n1 r^2 + n2 r^4 + ...) / (1 + d1 r^2 + d2 r^4 + ...)
             x' = x s + 2 p1 x y + p2 (r^2 + 2 x^2),   y' = y s + 2 p2 x y + p1 (r^2 + 2 y^2)
fisheye      t = atan(r);  (x', y') = (x, y) t (1 + n1 t^2 + n2 t^4 + ...) / r, plus the tangential terms above of
             (x, y) t / r (Metashape, OpenSfM's fisheye62), and those of a thin prism: s1 t^2, s2 t^2
fov          (x', y') = (x, y) atan(2 r tan(w/2)) / (w r)

A sensor whose axes are not at right angles (Metashape's b2) shears what the lens made: x' + skew y'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import brentq

from gs2d.errors import DataError, UnusableViewError

_NEWTON = 20  # steps at the most, from the bent point to the ideal one

_COLMAP_PINHOLE = {"SIMPLE_PINHOLE", "PINHOLE"}
#: COLMAP model -> (kind, order of its distortion parameters)
_COLMAP_LENSES = {
    "SIMPLE_RADIAL": ("perspective", "n1"),
    "RADIAL": ("perspective", "n1 n2"),
    "OPENCV": ("perspective", "n1 n2 p1 p2"),
    "FULL_OPENCV": ("perspective", "n1 n2 p1 p2 n3 d1 d2 d3"),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", "n1"),
    "RADIAL_FISHEYE": ("fisheye", "n1 n2"),
    "OPENCV_FISHEYE": ("fisheye", "n1 n2 n3 n4"),
    "THIN_PRISM_FISHEYE": ("fisheye", "n1 n2 p1 p2 n3 n4 s1 s2"),
    "SIMPLE_FISHEYE": ("fisheye", ""),
    "FISHEYE": ("fisheye", ""),
    "FOV": ("fov", "w"),
}


@dataclass(frozen=True)
class Lens:
    """A lens that bends: see the module's formulas.

    Attributes
    ----------
    kind : str
        "perspective", "fisheye" or "fov".
    radial : tuple of float
        n1, n2, ... (for "fov": the angle w).
    divisor : tuple of float
        d1, d2, ...
    tangential : tuple of 2 floats
        p1, p2 ("perspective" and "fisheye").
    skew : float
        Shear of the sensor, in units of fx.
    prism : tuple of 2 floats
        s1, s2 ("fisheye").
    """

    kind: str
    radial: tuple[float, ...] = ()
    divisor: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    skew: float = 0.0
    prism: tuple[float, float] = (0.0, 0.0)

    @property
    def is_identity(self) -> bool:
        """True if nothing bends, so that images need no undistortion."""
        if self.skew:
            return False
        if self.kind == "perspective":
            return not (any(self.radial) or any(self.divisor) or any(self.tangential))
        return self.kind == "fov" and abs(self.radial[0]) < 1e-9

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Ideal points [..., 2] to the points that the sensor saw [..., 2] (plane z = 1)."""
        x, y = points[..., 0], points[..., 1]
        r2 = x * x + y * y
        if self.kind == "fisheye":
            return self.bend(points, np.arctan(np.maximum(np.sqrt(r2), 1e-12)))
        scale = self._radial_scale(np.sqrt(r2))
        p1, p2 = self.tangential
        u, v = x * scale, y * scale
        u, v = u + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), v + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        return np.stack([u + self.skew * v if self.skew else u, v], axis=-1)

    def bend(self, directions: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return where a fisheye shows rays at angles ``t`` [...], rad, from its axis: points as of :meth:`distort`.

        ``directions`` [..., 2] point from the axis to the rays; their length does not matter. Unlike a point on the
        plane z = 1 an angle may be 90 degrees and more.
        """
        x, y = directions[..., 0], directions[..., 1]
        r = np.maximum(np.sqrt(x * x + y * y), 1e-12)
        scale = np.asarray(t * _polynomial(self.radial, t * t) / r)
        u, v = x * scale, y * scale
        p1, p2 = self.tangential
        if p1 or p2 or any(self.prism):  # of the bent point
            x, y, r2 = x * t / r, y * t / r, t**2
            u = u + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + self.prism[0] * r2
            v = v + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + self.prism[1] * r2
        return np.stack([u + self.skew * v if self.skew else u, v], axis=-1)

    def _radial_scale(self, r: np.ndarray) -> np.ndarray:
        if self.kind == "perspective":
            r2 = r * r
            return np.asarray(_polynomial(self.radial, r2) / _polynomial(self.divisor, r2))
        safe = np.maximum(r, 1e-12)
        if self.kind == "fisheye":
            t = np.arctan(safe)
            return np.asarray(t * _polynomial(self.radial, t * t) / safe)
        w = self.radial[0]
        return np.asarray(np.arctan(2 * safe * math.tan(w / 2)) / (w * safe))

    def largest_radius(self) -> float:
        """Return the ideal radius up to which the radial mapping grows; beyond it a polynomial folds back."""

        def radius(r: float) -> float:
            return float(r * self._radial_scale(np.array(r)))

        # A field of view of 175 degrees is more than any pinhole image holds.
        grid = np.tan(np.linspace(0.0, math.radians(87.5), 2000))
        with np.errstate(all="ignore"):
            values = grid * self._radial_scale(grid)
        falls = np.flatnonzero(~(np.diff(values) > 0))
        if not len(falls):
            return math.inf
        low, high = float(grid[max(falls[0] - 1, 0)]), float(grid[falls[0] + 1])

        def slope(r: float) -> float:
            h = 1e-6 * max(r, 1e-3)
            return (radius(r + h) - radius(max(r - h, 0.0))) / h

        return brentq(slope, low, high) if slope(low) > 0 > slope(high) else low


def _polynomial(coefficients: tuple[float, ...], x: np.ndarray) -> np.ndarray:
    """1 + c1 x + c2 x^2 + ..."""
    value = np.zeros_like(x)
    for coefficient in reversed(coefficients):
        value = (value + coefficient) * x
    return np.asarray(value + 1.0)


@dataclass(frozen=True)
class Intrinsics:
    """What a data set says about a lens: pixels of an image of width x height, and the lens if it bends."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens | None = None

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the pixels [..., 2] of the file where ideal points [..., 2] on the plane z = 1 are seen."""
        bent = points if self.lens is None else self.lens.distort(points)
        return np.asarray(bent * (self.fx, self.fy) + (self.cx, self.cy))

    def ideal(self, pixels: np.ndarray) -> np.ndarray:
        """Return the points [P, 2] on the plane z = 1 that are seen at pixels [P, 2] of the file: Newton's method.

        Raises
        ------
        DataError
            A pixel that nothing is seen at through this lens.
        """
        bent = (np.asarray(pixels, np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.lens is None:
            return bent
        lens, x, h = self.lens, bent.copy(), 1e-6
        du, dv = np.array([h, 0.0]), np.array([0.0, h])
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON):
                across = (lens.distort(x + du) - lens.distort(x - du)) / (2 * h)
                along = (lens.distort(x + dv) - lens.distort(x - dv)) / (2 * h)
                left = lens.distort(x) - bent
                x = x - np.linalg.solve(np.stack([across, along], axis=-1), left[..., None])[..., 0]
            off = np.linalg.norm(lens.distort(x) - bent, axis=-1) * max(self.fx, self.fy)
            known = (off < 1e-3) & (np.linalg.norm(x, axis=-1) < lens.largest_radius())
        if not known.all():
            u, v = np.asarray(pixels)[np.flatnonzero(~known)[0]]
            raise DataError(f"a pixel that the lens maps to was expected, got {u:g}, {v:g} beyond its reach")
        return x

    def scaled(self, width: int, height: int) -> Intrinsics:
        """Return the same camera for another size of its images (a lens is free of scale)."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, self.lens)


def colmap_intrinsics(camera: str, model: str, width: int, height: int, params: tuple[float, ...]) -> Intrinsics:
    """Intrinsics of a COLMAP camera (the principal point's origin is the corner of the image, as ours).

    Parameters
    ----------
    camera : str
        How to name the camera in an error.
    model : str
        COLMAP's name of the model.
    params : tuple of float
        In COLMAP's order.

    Raises
    ------
    UnusableViewError
        Parameters that are NaN or infinite.
    DataError
        A model that we do not undistort, another number of parameters, or values that are no camera.
    """
    if model not in _COLMAP_PINHOLE and model not in _COLMAP_LENSES:
        valid = ", ".join(sorted(_COLMAP_PINHOLE | set(_COLMAP_LENSES)))
        raise DataError(
            f"{camera} has the model {model}, which cannot be undistorted here (known: {valid}); "
            "run `colmap image_undistorter` and load its output"
        )
    single = model.startswith("SIMPLE_") or model in ("RADIAL", "RADIAL_FISHEYE")
    kind, names = _COLMAP_LENSES.get(model, ("", ""))
    words = names.split()
    expected = (3 if single else 4) + len(words)
    if len(params) != expected:
        raise DataError(f"{camera}: the model {model} must have {expected} parameters, got {len(params)}")
    fx, fy, cx, cy = (params[0], *params[:3]) if single else params[:4]
    if not all(map(math.isfinite, params)):
        raise UnusableViewError(f"{camera} must have finite parameters, got {list(params)}")
    if not (fx > 0 and fy > 0 and width > 0 and height > 0):
        raise DataError(f"{camera} must have a positive size and focal length, got {width}x{height} and {list(params)}")
    value = dict(zip(words, params[3 if single else 4 :], strict=True))
    lens = None
    if kind == "fov":
        lens = Lens("fov", (value["w"],))
    elif kind:
        lens = Lens(
            kind,
            radial=tuple(value[w] for w in sorted(words) if w[0] == "n"),
            divisor=tuple(value[w] for w in sorted(words) if w[0] == "d"),
            tangential=(value.get("p1", 0.0), value.get("p2", 0.0)),
            prism=(value.get("s1", 0.0), value.get("s2", 0.0)),
        )
    return Intrinsics(width, height, fx, fy, cx, cy, None if lens is None or lens.is_identity else lens)


def source_positions(intrinsics: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of the undistorted image comes from.

    The undistorted camera keeps size, focal lengths and principal point, so the forward distortion of its pixel
    centres (i + 0.5, j + 0.5) is the exact inverse map: no iteration.

    Returns
    -------
    positions : ndarray float32 [H, W, 2] px, corner origin
    valid : ndarray bool [H, W]
        True where the position lies between pixel centres of the distorted image and the lens is one to one.
    """
    k, lens = intrinsics, intrinsics.lens
    x = (np.arange(k.width) + 0.5 - k.cx) / k.fx
    y = (np.arange(k.height) + 0.5 - k.cy) / k.fy
    ideal = np.stack(np.meshgrid(x, y), axis=-1)  # [H, W, 2]
    if lens is None:
        bent, valid = ideal, np.ones(ideal.shape[:2], dtype=bool)
    else:
        with np.errstate(all="ignore"):
            bent = lens.distort(ideal)
        valid = np.hypot(ideal[..., 0], ideal[..., 1]) < lens.largest_radius()
    positions = bent * (k.fx, k.fy) + (k.cx, k.cy)
    # Between the outer pixel centres every sample is an interpolation; a thousandth of a pixel is rounding.
    low, high = 0.499, np.array((k.width, k.height)) - 0.499
    inside = ((positions >= low) & (positions <= high)).all(axis=-1)
    valid &= inside  # comparisons with NaN are False
    return np.where(valid[..., None], positions, 0.0).astype(np.float32), valid


def undistort_image(image: np.ndarray, positions: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Sample an image bilinearly at ``positions`` (from ``source_positions``); 0 where not valid.

    Colour is interpolated premultiplied by alpha and stored straight.

    Parameters
    ----------
    image : ndarray uint8 [H, W, 3 or 4]
    """
    planes = torch.from_numpy(np.array(image)).permute(2, 0, 1).to(torch.float32)  # [C, H, W]
    has_alpha = len(planes) == 4
    if has_alpha:
        planes[:3] *= planes[3:] / 255.0
    sampled = _sample(planes, positions)
    if has_alpha:
        sampled[:3] *= 255.0 / sampled[3:].clamp_min(0.5)  # below half a level alpha rounds to 0
    pixels = sampled.add_(0.5).clamp_(0, 255).to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    pixels[~valid] = 0
    return pixels


def undistort_mask(mask: np.ndarray, positions: np.ndarray, *, need: float) -> np.ndarray:
    """Sample a mask bool [H, W] at ``positions``: True where its bilinear value reaches ``need``."""
    plane = torch.from_numpy(mask.astype(np.float32))[None]
    return np.asarray(_sample(plane, positions)[0].numpy() >= need - 1e-4)


def _sample(planes: torch.Tensor, positions: np.ndarray) -> torch.Tensor:
    """Bilinear samples of planes [C, H, W] at positions [H', W', 2] px; the border's pixels extend outwards."""
    height, width = planes.shape[1:]
    # grid_sample with align_corners=False puts -1 and 1 at the outer edges, so pixel centres are at +0.5 as ours.
    grid = torch.from_numpy(positions) * torch.tensor([2.0 / width, 2.0 / height]) - 1.0
    return torch.nn.functional.grid_sample(
        planes[None], grid[None], mode="bilinear", padding_mode="border", align_corners=False
    )[0]
