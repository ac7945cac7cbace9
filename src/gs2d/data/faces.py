"""Pinhole faces of panoramas and wide fisheyes.

The faces are those of a cube around the camera: front, right, back, left, up, down, 90 degrees each, at the resolution
of the image in the middle of the face.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gs2d.core.image_arrays import is_twice_as_wide
from gs2d.data.camera_models import PANORAMA, Lens, model_of
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError

WIDEST = 120.0  # degrees; wider fisheyes are split, because a pinhole image would stretch the rim fourfold
LEAST_SHOWN = 0.02  # smallest visible fraction of a face
GLANCE = 64  # px, face size for measuring the visible fraction
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
    """A face of an image: its name and the side of its square image, px."""

    name: str
    side: int

    @property
    def rotation(self) -> np.ndarray:
        """R_face_camera [3, 3]: x_face = R x_camera."""
        right, up = np.radians(_TURNS[self.name])
        # The axis of the face is rotated right about y (down) and up about x.
        turn = np.array([[math.cos(right), 0, math.sin(right)], [0, 1, 0], [-math.sin(right), 0, math.cos(right)]])
        rise = np.array([[1, 0, 0], [0, math.cos(up), -math.sin(up)], [0, math.sin(up), math.cos(up)]])
        return np.asarray(np.rint((turn @ rise).T))

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of the face: 90 degrees wide."""
        half = self.side / 2
        return Intrinsics(self.side, self.side, half, half, half, half)


def panorama(width: int, height: int, where: str) -> Intrinsics:
    """Return the intrinsics of an equirectangular panorama.

    Raises DataError if it is not twice as wide as high.
    """
    if not is_twice_as_wide(width, height):
        raise DataError(
            f"{where}: an equirectangular panorama must be twice as wide as high, got {width}x{height}; was it cropped?"
        )
    fx, fy = width / (2 * math.pi), height / math.pi
    return Intrinsics(width, height, fx, fy, width / 2, height / 2, Lens(PANORAMA))


def field_of_view(k: Intrinsics) -> float:
    """Return the horizontal field of view of an image, degrees; for wide camera models along the axis."""
    lens = k.lens
    if lens is None or not model_of(lens).is_wide:
        return math.degrees(2 * math.atan(k.width / 2 / k.fx))
    t = np.linspace(0.0, math.pi, 4000)
    points, shown = lens.project(np.stack([np.sin(t), 0 * t, np.cos(t)], axis=-1))
    reach = np.where(shown, np.abs(points[:, 0]) * k.fx, np.inf)
    at = np.searchsorted(reach, (k.cx, k.width - k.cx)).clip(max=max(int(shown.sum()) - 1, 0))
    return math.degrees(float(t[at].sum()))


def faces_of(k: Intrinsics) -> tuple[Face, ...]:
    """Return the faces of an image; none if one pinhole image suffices."""
    if k.lens is None or not model_of(k.lens).is_wide or field_of_view(k) <= WIDEST:
        return ()
    every = [Face(name, 2 * max(1, round(k.fx))) for name in FACES]  # 90 degrees at this focal length
    return tuple(face for face in every if face_positions(k, replace(face, side=GLANCE))[1].mean() >= LEAST_SHOWN)


def face_positions(k: Intrinsics, face: Face) -> tuple[np.ndarray, np.ndarray]:
    """Return the source position of each pixel of a face, as ``undistort.source_positions``.

    For panoramas, positions refer to ``wrapped`` images, which have one more column on each side.
    """
    centres = (np.arange(face.side) + 0.5 - face.side / 2) / (face.side / 2)
    x, y = np.meshgrid(centres, centres)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ face.rotation  # rows r^T R = (R^T r)^T
    positions, valid = k.project_rays(rays)
    if k.lens is not None and model_of(k.lens).wraps:
        positions = positions + np.array((1.0, 0.0))
    else:
        low, high = 0.499, np.array((k.width, k.height)) - 0.499
        valid = valid & ((positions >= low) & (positions <= high)).all(axis=-1)
    return np.where(valid[..., None], positions, 0.0).astype(np.float32), valid


def wrapped(image: np.ndarray, k: Intrinsics) -> np.ndarray:
    """Pad a panorama [H, W, ...] with its last column on the left and its first on the right; else unchanged."""
    if k.lens is None or not model_of(k.lens).wraps:
        return image
    return np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)


def face_name(name: str, face: Face) -> str:
    """Return the name of a face: ``a/b_front.jpg`` of ``a/b.jpg``."""
    stem, dot, ending = name.rpartition(".")
    return f"{stem}_{face.name}{dot}{ending}" if dot and "/" not in ending else f"{name}_{face.name}"
