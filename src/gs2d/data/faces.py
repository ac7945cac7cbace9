"""Photographs that no pinhole image holds, panoramas and wide fisheyes, cut into pinhole faces of 90 degrees.

The faces are those of a cube around the camera: front, right, back, left, up, down, each as fine in its middle as the
photograph is there. All of them stand where the photograph was taken. Their pixels are sampled where the projection of
the photograph says, so nothing is lost but what the photograph does not show.

An equirectangular panorama of W x H = W x W/2 pixels shows a ray (x, y, z), x right, y down, z ahead, at

u = W/2 + W / (2 pi) atan2(x, z),   v = H/2 + H / pi atan2(y, sqrt(x^2 + z^2))
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gs2d.core.images import is_twice_as_wide
from gs2d.data.undistort import Intrinsics, Lens
from gs2d.errors import DataError

PANORAMA = "equirectangular"
WIDEST = 120.0  # degrees: a wider fisheye is cut; in a pinhole image of it the rim would be stretched fourfold
LEAST_SHOWN = 0.02  # of a face's pixels that the photograph must show; a sliver teaches nothing
GLANCE = 64  # px of a face, to see how much of it is shown
_TURNS = {  # degrees to the right, then up
    "front": (0, 0),
    "right": (90, 0),
    "back": (180, 0),
    "left": (-90, 0),
    "up": (0, 90),
    "down": (0, -90),
}
FACES = tuple(_TURNS)


@dataclass(frozen=True)
class Face:
    """One face of a photograph: its name, and the side of its square picture, px."""

    name: str
    side: int

    @property
    def rotation(self) -> np.ndarray:
        """R_face_camera [3, 3]: x_face = R x_camera."""
        right, up = np.radians(_TURNS[self.name])
        # A ray ahead of the face is turned right about y (down) and up about x.
        turn = np.array([[math.cos(right), 0, math.sin(right)], [0, 1, 0], [-math.sin(right), 0, math.cos(right)]])
        rise = np.array([[1, 0, 0], [0, math.cos(up), -math.sin(up)], [0, math.sin(up), math.cos(up)]])
        return np.asarray(np.rint((turn @ rise).T))

    @property
    def intrinsics(self) -> Intrinsics:
        """Of its picture: 90 degrees across."""
        half = self.side / 2
        return Intrinsics(self.side, self.side, half, half, half, half)


def panorama(width: int, height: int, where: str) -> Intrinsics:
    """Return the intrinsics of an equirectangular panorama.

    Raises
    ------
    DataError
        It is not twice as wide as high.
    """
    if not is_twice_as_wide(width, height):
        raise DataError(
            f"{where}: an equirectangular panorama must be twice as wide as high, got {width}x{height}; was it cropped?"
        )
    fx, fy = width / (2 * math.pi), height / math.pi
    return Intrinsics(width, height, fx, fy, width / 2, height / 2, Lens(PANORAMA))


def project_rays(k: Intrinsics, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels [..., 2] where a panorama or a fisheye shows rays [..., 3], and whether it shows them [...]."""
    x, y, z = rays[..., 0], rays[..., 1], rays[..., 2]
    lens = k.lens
    assert lens is not None
    if lens.kind == PANORAMA:
        u, v = k.cx + k.fx * np.arctan2(x, z), k.cy + k.fy * np.arctan2(y, np.hypot(x, z))
        return np.stack([u, v], axis=-1), np.ones(u.shape, dtype=bool)
    t = np.arctan2(np.hypot(x, y), z)
    bent = lens.bend(np.stack([x, y], axis=-1), t)
    return bent * (k.fx, k.fy) + (k.cx, k.cy), t < _last_angle(lens)


def _last_angle(lens: Lens) -> float:
    """Return the angle up to which a fisheye's radius grows, rad; beyond it a polynomial folds back."""
    t = np.linspace(0.0, math.pi, 4000)
    reach = lens.bend(np.stack([np.ones_like(t), 0 * t], axis=-1), t)[:, 0]
    falls = np.flatnonzero(~(np.diff(reach) > 0))
    return float(t[falls[0]]) if len(falls) else math.pi


def field_of_view(k: Intrinsics) -> float:
    """Return the angle between the left and the right edge of a photograph, degrees (of a fisheye: along its axis)."""
    lens = k.lens
    if lens is None or lens.kind not in (PANORAMA, "fisheye"):
        return math.degrees(2 * math.atan(k.width / 2 / k.fx))
    if lens.kind == PANORAMA:
        return 360.0
    t = np.linspace(0.0, _last_angle(lens), 4000)[:-1]
    reach = np.abs(lens.bend(np.stack([np.ones_like(t), 0 * t], axis=-1), t)[:, 0]) * k.fx
    at = np.searchsorted(reach, (k.cx, k.width - k.cx)).clip(max=len(t) - 1)
    return math.degrees(float(t[at].sum()))


def faces_of(k: Intrinsics) -> tuple[Face, ...]:
    """Return the faces that a photograph is cut into: none where one pinhole image will do."""
    if k.lens is None or k.lens.kind not in (PANORAMA, "fisheye") or field_of_view(k) <= WIDEST:
        return ()
    every = [Face(name, 2 * max(1, round(k.fx))) for name in FACES]  # 90 degrees at this focal length
    return tuple(face for face in every if face_positions(k, replace(face, side=GLANCE))[1].mean() >= LEAST_SHOWN)


def face_positions(k: Intrinsics, face: Face) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of a face comes from: as ``undistort.source_positions``.

    Of a panorama in pixels of ``wrapped`` pictures, one column wider on each side.
    """
    centres = (np.arange(face.side) + 0.5 - face.side / 2) / (face.side / 2)
    x, y = np.meshgrid(centres, centres)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ face.rotation  # rows r^T R = (R^T r)^T
    positions, valid = project_rays(k, rays)
    if k.lens is not None and k.lens.kind == PANORAMA:
        positions = positions + np.array((1.0, 0.0))
    else:
        low, high = 0.499, np.array((k.width, k.height)) - 0.499
        valid = valid & ((positions >= low) & (positions <= high)).all(axis=-1)
    return np.where(valid[..., None], positions, 0.0).astype(np.float32), valid


def wrapped(image: np.ndarray, k: Intrinsics) -> np.ndarray:
    """Return a panorama [H, W, ...] with its last column before the first, its first after the last; others as is."""
    if k.lens is None or k.lens.kind != PANORAMA:
        return image
    return np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)


def face_name(name: str, face: Face) -> str:
    """Return what a face is called: ``a/b_front.jpg`` of ``a/b.jpg``."""
    stem, dot, ending = name.rpartition(".")
    return f"{stem}_{face.name}{dot}{ending}" if dot and "/" not in ending else f"{name}_{face.name}"
