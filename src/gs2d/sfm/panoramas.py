"""Which photographs are 360-degree panoramas: by what their files say, or because a picture meets itself.

COLMAP places them by its own spherical camera, one pose a panorama; training cuts them into faces (``data.faces``).
"""

from __future__ import annotations

import numpy as np
from PIL import Image

from gs2d.core.images import is_twice_as_wide

PANORAMA = "EQUIRECTANGULAR"
FINER = 2  # times --feature-size: a panorama shows four times what a photograph does across
_SMALL = (512, 256)  # px, in which edges are compared: noise and compression are averaged out
_STEP, _LEVELS = 3.0, 2.0  # the step over the seam: so many times that of neighbouring columns, and levels
_ONE_COLOUR = 0.5  # of the spread of a row in the middle, that the uppermost row may have: it is one direction
_DARK, _DARK_MOST = 8, 0.5  # levels; of the seam: two round fisheye pictures side by side meet in black


def meets_itself(image: np.ndarray) -> bool:
    """Whether a picture is that of a whole sphere: its left edge goes on at its right one, its top row is one place.

    Parameters
    ----------
    image : ndarray uint8 [H, W, 3 or 4]
    """
    height, width = image.shape[:2]
    if width < _SMALL[0] // 4 or not is_twice_as_wide(width, height):
        return False
    small = np.asarray(Image.fromarray(image[..., :3]).resize(_SMALL, Image.Resampling.BOX), dtype=np.float64)
    steps = np.abs(np.diff(small, axis=1)).mean()
    seam = np.abs(small[:, 0] - small[:, -1]).mean()
    spread = small.std(axis=1).mean(axis=1)  # of each row
    dark = (small[:, [0, -1]].max(axis=(1, 2)) < _DARK).mean()
    top = float(spread[0]) <= _ONE_COLOUR * float(spread[len(spread) // 4 : -len(spread) // 4].mean()) + _LEVELS
    return bool(seam <= _STEP * steps + _LEVELS and top and dark <= _DARK_MOST)
