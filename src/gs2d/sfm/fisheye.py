"""Which photographs may be those of a fisheye: by the circle that such a lens draws, or by the name of its camera.

The circle is where all photographs of one camera are dark beyond it: one that is still among pictures that are not.
Neither is proof (a statue that turns before black velvet, an action camera that stretches its pictures itself): what
the photographs show in common decides (``gs2d.sfm.lens_probe``).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

SMALL = 256  # px, the longer side on which a circle is looked for
DARK = 24  # levels of 255: as bright as noise and stray light leave what no light reaches
_CORNER = 0.03  # of the sides: a patch in each corner, all of which are dark, or no circle is looked for
_ANGLES = 360  # directions, in which the edge of the circle is looked for
_QUARTERS = 4  # each must show some of the edge
_OF_QUARTER = 0.1  # of its directions
_ROUND = 0.012  # of the radius, root mean square: how far the edge may be from a circle
_STEPS = 5  # of fitting, each without what the one before was far from
_MIDDLE = 0.1  # of the longer side, that the middle of the circle may be off that of the picture
_LEAST = 0.35  # of the shorter side: the radius of a circle that somebody photographs with
_FULL, _DARK = 0.9, 0.97  # of the pixels: so many are bright in some photograph well within the circle, dark beyond
_WITHIN, _BEYOND = 0.97, 1.02  # times the radius
INSIDE = 0.98  # times the radius: the rim is blurred and has the colours of the glass
# Makers' names, and words of lenses. Action cameras can store pictures that are stretched already ("linear").
_NAMES = re.compile(
    r"fish-?\s?eye|gopro|\bhero\s?\d|insta\s?360|osmo ?action|\baction\s?\d|\bsjcam|\bakaso|\byi (4k|lite)|xiaoyi|"
    r"\bfdr-x|\bhdr-as|drift (ghost|x)|garmin virb|\btg-tracker|entaniya|madv|laowa 4mm",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Circle:
    """The circle of a fisheye, as fractions of the picture: its middle of width and height, its radius of the longer.

    Attributes
    ----------
    x, y : float
    radius : float
    """

    x: float
    y: float
    radius: float

    def inside(self, width: int, height: int) -> np.ndarray:
        """Return which pixels [H, W] of a picture are within the circle, its blurred rim left out."""
        v, u = np.mgrid[:height, :width] + 0.5
        return np.asarray(np.hypot(u - self.x * width, v - self.y * height) < self.reach(width, height))

    def reach(self, width: int, height: int) -> float:
        """Return the radius of what is used, px."""
        return INSIDE * self.radius * max(width, height)


def named_fisheye(made_by: Sequence[str]) -> bool:
    """Whether the names of camera and lens (EXIF) are those of action cameras or fisheyes."""
    return any(_NAMES.search(name) for name in made_by)


def small_if_dark(image: np.ndarray) -> np.ndarray | None:
    """Return the brightest channel of a picture, small, float32 [h, w]; None where a corner is not dark: no circle.

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


def circle_of(pictures: Sequence[np.ndarray | None]) -> Circle | None:
    """Return the circle that the photographs of one camera share, or None.

    Parameters
    ----------
    pictures : sequence of ndarray [h, w] or None
        As of :func:`small_if_dark`; of one size.
    """
    dark = [picture for picture in pictures if picture is not None]
    if not dark or 10 * len(dark) < 9 * len(pictures) or len({picture.shape for picture in dark}) > 1:
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
    """Return directions (numbers) and places [P, 3] of the outermost bright pixels, where it is dark beyond them."""
    height, width = brightest.shape
    middle, found = np.array([width / 2, height / 2]), []
    for number in range(_ANGLES):
        a = 2 * np.pi * (number + 0.5) / _ANGLES
        ray = np.array([np.cos(a), np.sin(a)])
        reach = min(middle / np.maximum(np.abs(ray), 1e-9)) - 0.5
        along = np.arange(0.0, reach, 0.25)
        u, v = (middle[:, None] + ray[:, None] * along).astype(int)
        bright = np.flatnonzero(brightest[v, u] >= DARK)
        if len(bright) and along[bright[-1]] < reach - 2:  # else the circle ends beyond the picture
            found.append((number, *(middle + ray * along[bright[-1]])))
    return np.array(found).reshape(-1, 3)


def _circle_through(points: np.ndarray) -> np.ndarray:
    """Return the circle (x, y, radius) [3] of least squares through points [P, 2]: x^2 + y^2 = 2 a x + 2 b y + c."""
    system = np.hstack([2 * points, np.ones((len(points), 1))])
    a, b, c = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0]
    return np.array([a, b, np.sqrt(max(c + a * a + b * b, 0.0))])


def _believed(brightest: np.ndarray, fit: np.ndarray, off: float) -> Circle | None:
    """Return the circle if pictures look like it: round, near the middle, bright within, dark beyond."""
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
