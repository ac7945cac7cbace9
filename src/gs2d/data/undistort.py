"""Undistortion: the source position of each pixel of a pinhole image, and resampling.

The formulas of the lenses are in :mod:`gs2d.data.camera_models`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from gs2d.data.camera_models import Lens
from gs2d.errors import DataError, UnusableViewError

#: COLMAP model, in the order of ids -> (number of parameters, kind, order of the distortion parameters);
#: kind "": not supported here
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": (3, "pinhole", ""),
    "PINHOLE": (4, "pinhole", ""),
    "SIMPLE_RADIAL": (4, "perspective", "n1"),
    "RADIAL": (5, "perspective", "n1 n2"),
    "OPENCV": (8, "perspective", "n1 n2 p1 p2"),
    "OPENCV_FISHEYE": (8, "fisheye", "n1 n2 n3 n4"),
    "FULL_OPENCV": (12, "perspective", "n1 n2 p1 p2 n3 d1 d2 d3"),
    "FOV": (5, "fov", "w"),
    "SIMPLE_RADIAL_FISHEYE": (4, "fisheye", "n1"),
    "RADIAL_FISHEYE": (5, "fisheye", "n1 n2"),
    "THIN_PRISM_FISHEYE": (12, "fisheye", "n1 n2 p1 p2 n3 n4 s1 s2"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (16, "", ""),
    "SIMPLE_DIVISION": (4, "", ""),
    "DIVISION": (5, "", ""),
    "SIMPLE_FISHEYE": (3, "fisheye", ""),
    "FISHEYE": (4, "fisheye", ""),
    "EUCM": (6, "", ""),
    "EQUIRECTANGULAR": (2, "", ""),  # readers make a panorama of it
}


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of an image in pixels, with its lens unless it is a pinhole image."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens | None = None

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project ideal points [..., 2] of the plane z = 1 to pixels [..., 2]."""
        bent = points if self.lens is None else self.lens.distort(points)
        return np.asarray(bent * (self.fx, self.fy) + (self.cx, self.cy))

    def project_rays(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project rays [..., 3] through the lens: pixels [..., 2], and which rays are visible [...] bool."""
        assert self.lens is not None
        points, shown = self.lens.project(rays)
        return points * (self.fx, self.fy) + (self.cx, self.cy), shown

    def rays(self) -> np.ndarray:
        """Return the unit rays [H, W, 3] of all pixels, for ``gs2d.render.rays.ray_map``; 0 where the lens has none."""
        u = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        v = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        return (self.lens or Lens("perspective")).unproject(np.stack(np.meshgrid(u, v), axis=-1))

    def scaled(self, width: int, height: int) -> Intrinsics:
        """Return the intrinsics for another image size."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, self.lens)


def colmap_intrinsics(camera: str, model: str, width: int, height: int, params: tuple[float, ...]) -> Intrinsics:
    """Return the intrinsics of a COLMAP camera.

    ``camera``: name of the camera in errors. ``model``: name of the camera model in COLMAP. ``params``: in the order of
    COLMAP. Raises UnusableViewError if a parameter is not finite. Raises DataError if the model is not supported, or
    the parameters are invalid.
    """
    expected, kind, names = COLMAP_MODELS.get(model, (0, "", ""))
    if not kind:
        valid = ", ".join(sorted(name for name, (_, kind, _) in COLMAP_MODELS.items() if kind))
        raise DataError(
            f"{camera} has the model {model}, which is not supported (supported: {valid}); "
            "run `colmap image_undistorter` and load its output"
        )
    words = names.split()
    single = expected - len(words) == 3  # one focal length
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
    elif kind != "pinhole":
        lens = Lens(
            kind,
            radial=tuple(value[w] for w in sorted(words) if w[0] == "n"),
            divisor=tuple(value[w] for w in sorted(words) if w[0] == "d"),
            tangential=(value.get("p1", 0.0), value.get("p2", 0.0)),
            prism=(value.get("s1", 0.0), value.get("s2", 0.0)),
        )
    return Intrinsics(width, height, fx, fy, cx, cy, None if lens is None or lens.is_identity else lens)


@lru_cache(maxsize=4)  # 12 bytes per pixel; cameras are mostly shared
def source_positions(intrinsics: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Return the source position of each pixel of the undistorted image, and which are valid.

    Positions are float32 [H, W, 2] px, corner origin. They are valid, bool [H, W], between the pixel centres of the
    distorted image and where the lens is one to one. The undistorted camera keeps size, focal lengths and principal
    point, so that the forward distortion of its pixel centres is the exact inverse map.
    """
    k = intrinsics
    x = (np.arange(k.width) + 0.5 - k.cx) / k.fx
    y = (np.arange(k.height) + 0.5 - k.cy) / k.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((k.height, k.width))], axis=-1)  # [H, W, 3]
    positions, valid = k.project_rays(rays)
    # Samples between the outer pixel centres are interpolated; 0.001 px allows for rounding.
    low, high = 0.499, np.array((k.width, k.height)) - 0.499
    inside = ((positions >= low) & (positions <= high)).all(axis=-1)
    valid = valid & inside  # comparisons with NaN are False
    return np.where(valid[..., None], positions, 0.0).astype(np.float32), valid


def undistort_image(image: np.ndarray, positions: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Sample an image bilinearly at ``positions`` (from ``source_positions``); 0 where invalid.

    Colour is interpolated premultiplied by alpha and stored straight. ``image`` is uint8 [H, W, 3 or 4].
    """
    planes = torch.from_numpy(np.array(image)).permute(2, 0, 1).to(torch.float32)  # [C, H, W]
    has_alpha = len(planes) == 4
    if has_alpha:
        planes[:3] *= planes[3:] / 255.0
    sampled = _sample(planes, positions)
    if has_alpha:
        sampled[:3] *= 255.0 / sampled[3:].clamp_min(0.5)  # smaller alpha rounds to 0
    pixels = sampled.add_(0.5).clamp_(0, 255).to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    pixels[~valid] = 0
    return pixels


def undistort_mask(mask: np.ndarray, positions: np.ndarray, *, need: float) -> np.ndarray:
    """Sample a mask bool [H, W] at ``positions``: True where its bilinear value reaches ``need``."""
    plane = torch.from_numpy(mask.astype(np.float32))[None]
    return np.asarray(_sample(plane, positions)[0].numpy() >= need - 1e-4)


def _sample(planes: torch.Tensor, positions: np.ndarray) -> torch.Tensor:
    """Sample planes [C, H, W] bilinearly at positions [H', W', 2] px; border pixels extend outwards."""
    height, width = planes.shape[1:]
    # With align_corners=False, -1 and 1 are the outer edges: pixel centres are at +0.5.
    grid = torch.from_numpy(positions) * torch.tensor([2.0 / width, 2.0 / height]) - 1.0
    return torch.nn.functional.grid_sample(
        planes[None], grid[None], mode="bilinear", padding_mode="border", align_corners=False
    )[0]
