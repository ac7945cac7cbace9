"""Hints at a fisheye: an image circle that all images of a camera share, or the name of the camera.

Neither is a proof: an object may turn in front of black velvet, and action cameras may correct distortion. The matches
decide (``gs2d.sfm.lens_probe``).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

SMALL = 256  # px, longer side of the images in which a circle is searched
DARK = 24  # of 255: noise and stray light outside the circle stay below
_CORNER = 0.03  # of the sides: size of the four corner patches that must be dark
_ANGLES = 360  # directions in which the edge is searched
_QUARTERS = 4  # quadrants that must show some of the edge,
_OF_QUARTER = 0.1  # in this fraction of their directions
_ROUND = 0.012  # of the radius: largest RMS distance of the edge from a circle
_STEPS = 5  # of the fit; each leaves out outliers of the step before
_MIDDLE = 0.1  # of the longer side: largest offset of the circle from the image centre
_LEAST = 0.35  # of the shorter side: smallest radius
_FULL, _DARK = 0.9, 0.97  # smallest fractions of bright pixels inside and of dark pixels outside
_WITHIN, _BEYOND = 0.97, 1.02  # times the radius: limits of inside and outside for that test
INSIDE = 0.98  # times the radius: the rim is blurred and coloured by the glass
# Names of makers and lenses. Action cameras can also store corrected images ("linear").
_NAMES = re.compile(
    r"fish-?\s?eye|gopro|\bhero\s?\d|insta\s?360|osmo ?action|\baction\s?\d|\bsjcam|\bakaso|\byi (4k|lite)|xiaoyi|"
    r"\bfdr-x|\bhdr-as|drift (ghost|x)|garmin virb|\btg-tracker|entaniya|madv|laowa 4mm",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Circle:
    """Image circle of a fisheye.

    Attributes
    ----------
    x, y : float
        Centre, as fractions of width and height.
    radius : float
        As a fraction of the longer side.
    """

    x: float
    y: float
    radius: float

    def inside(self, width: int, height: int) -> np.ndarray:
        """Return a mask [H, W] of the pixels inside the circle, without its blurred rim."""
        v, u = np.mgrid[:height, :width] + 0.5
        return np.asarray(np.hypot(u - self.x * width, v - self.y * height) < self.reach(width, height))

    def reach(self, width: int, height: int) -> float:
        """Return the radius of the used part, px."""
        return INSIDE * self.radius * max(width, height)


def named_fisheye(made_by: Sequence[str]) -> bool:
    """Whether the EXIF names of camera and lens belong to an action camera or a fisheye."""
    return any(_NAMES.search(name) for name in made_by)


def small_if_dark(image: np.ndarray) -> np.ndarray | None:
    """Return the brightest channel of a downscaled image, float32 [h, w]; None unless all corners are dark.

    Parameters
    ----------
    image : ndarray uint8 [H, W, 3 or 4]
    """
    height, width = image.shape[:2]
    h, w = max(1, round(_CORNER * height)), max(1, round(_CORNER * width))
    corners = (image[:h, :w], image[:h, -w:], image[-h:, :w], image[-h:, -w:])
    if min(height, width) < SMALL // 4 or any(np.median(corner[..., :3].max(axis=-1)) >= DARK for corner in corners):
        return None
    scale = min(1.0, SMALL / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = np.asarray(Image.fromarray(image[..., :3]).resize(size, Image.Resampling.BOX))
    return np.asarray(small.max(axis=-1), np.float32)


def circle_of(images: Sequence[np.ndarray | None]) -> Circle | None:
    """Return the image circle that the images of one camera share, or None.

    Parameters
    ----------
    images : sequence of ndarray [h, w] or None
        From :func:`small_if_dark`.
    """
    dark = [image for image in images if image is not None]
    if not dark or 10 * len(dark) < 9 * len(images) or len({image.shape for image in dark}) > 1:
        return None
    brightest = np.max(np.stack(dark), axis=0)
    edge = _edge(brightest)
    quarters = np.bincount((edge[:, 0] // (_ANGLES / _QUARTERS)).astype(int), minlength=_QUARTERS)
    if len(edge) < 3 or quarters.min() < _OF_QUARTER * _ANGLES / _QUARTERS:
        return None
    points, fit = edge[:, 1:], np.zeros(3)
    for _ in range(_STEPS):
        fit = _circle_through(points)
        off = np.hypot(*(edge[:, 1:] - fit[:2]).T) - fit[2]
        points = edge[np.abs(off) <= max(3 * _ROUND * fit[2], float(np.median(np.abs(off)))), 1:]
        if len(points) < 3:
            return None
    return _believed(brightest, fit, float(np.sqrt(np.mean(np.clip(off, None, 0) ** 2))))


def _edge(brightest: np.ndarray) -> np.ndarray:
    """Return direction index and pixel (x, y) [P, 3] of the outermost bright pixels that have dark ones outside."""
    height, width = brightest.shape
    middle, found = np.array([width / 2, height / 2]), []
    for number in range(_ANGLES):
        a = 2 * np.pi * (number + 0.5) / _ANGLES
        ray = np.array([np.cos(a), np.sin(a)])
        reach = min(middle / np.maximum(np.abs(ray), 1e-9)) - 0.5
        along = np.arange(0.0, reach, 0.25)
        u, v = (middle[:, None] + ray[:, None] * along).astype(int)
        bright = np.flatnonzero(brightest[v, u] >= DARK)
        if len(bright) and along[bright[-1]] < reach - 2:  # otherwise the circle is cut off by the border
            found.append((number, *(middle + ray * along[bright[-1]])))
    return np.array(found).reshape(-1, 3)


def _circle_through(points: np.ndarray) -> np.ndarray:
    """Return the least-squares circle (x, y, radius) of points [P, 2]: x^2 + y^2 = 2 a x + 2 b y + c."""
    system = np.hstack([2 * points, np.ones((len(points), 1))])
    a, b, c = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0]
    return np.array([a, b, np.sqrt(max(c + a * a + b * b, 0.0))])


def _believed(brightest: np.ndarray, fit: np.ndarray, off: float) -> Circle | None:
    """Return the circle if it is plausible: a round edge, near the centre, bright inside, dark outside."""
    height, width = brightest.shape
    longer = max(height, width)
    if off > _ROUND * fit[2] or fit[2] < _LEAST * min(height, width):
        return None
    if max(abs(fit[0] - width / 2), abs(fit[1] - height / 2)) > _MIDDLE * longer:
        return None
    v, u = np.mgrid[:height, :width] + 0.5
    r = np.hypot(u - fit[0], v - fit[1]) / fit[2]
    bright = brightest >= DARK
    if bright[r < _WITHIN].mean() < _FULL or (~bright[r > _BEYOND]).mean() < _DARK:
        return None
    return Circle(float(fit[0] / width), float(fit[1] / height), float(fit[2] / longer))
