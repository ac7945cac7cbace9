"""Photographs that see more than one pinhole image holds, panoramas and wide fisheyes, cut into pinhole faces.

The faces are those of a cube around the camera: front, right, back, left, up, down, 90 degrees each, at the resolution
that the photograph has in the middle of the face. All faces have the camera centre of the photograph. Their pixels are
sampled where the camera model (:mod:`gs2d.data.camera_models`) shows their rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gs2d.core.images import is_twice_as_wide
from gs2d.data.camera_models import PANORAMA, Lens, model_of
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError

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


def field_of_view(k: Intrinsics) -> float:
    """Return the horizontal field of view of a photograph in degrees; of a wide camera model along its axis."""
    lens = k.lens
    if lens is None or not model_of(lens).is_wide:
        return math.degrees(2 * math.atan(k.width / 2 / k.fx))
    t = np.linspace(0.0, math.pi, 4000)
    points, shown = lens.project(np.stack([np.sin(t), 0 * t, np.cos(t)], axis=-1))
    reach = np.where(shown, np.abs(points[:, 0]) * k.fx, np.inf)
    at = np.searchsorted(reach, (k.cx, k.width - k.cx)).clip(max=max(int(shown.sum()) - 1, 0))
    return math.degrees(float(t[at].sum()))


def faces_of(k: Intrinsics) -> tuple[Face, ...]:
    """Return the faces that a photograph is cut into: none where one pinhole image will do."""
    if k.lens is None or not model_of(k.lens).is_wide or field_of_view(k) <= WIDEST:
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
    positions, valid = k.project_rays(rays)
    if k.lens is not None and model_of(k.lens).wraps:
        positions = positions + np.array((1.0, 0.0))
    else:
        low, high = 0.499, np.array((k.width, k.height)) - 0.499
        valid = valid & ((positions >= low) & (positions <= high)).all(axis=-1)
    return np.where(valid[..., None], positions, 0.0).astype(np.float32), valid


def wrapped(image: np.ndarray, k: Intrinsics) -> np.ndarray:
    """Return a panorama [H, W, ...] with its last column before the first, its first after the last; others as is."""
    if k.lens is None or not model_of(k.lens).wraps:
        return image
    return np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)


def face_name(name: str, face: Face) -> str:
    """Return what a face is called: ``a/b_front.jpg`` of ``a/b.jpg``."""
    stem, dot, ending = name.rpartition(".")
    return f"{stem}_{face.name}{dot}{ending}" if dot and "/" not in ending else f"{name}_{face.name}"
