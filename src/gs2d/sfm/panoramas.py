"""Detect 360-degree panoramas by their metadata or content.

COLMAP places them with its spherical camera, one pose per panorama; training cuts them into faces (``data.faces``).
"""

from __future__ import annotations

import numpy as np
from PIL import Image

from gs2d.core.image_arrays import is_twice_as_wide

PANORAMA = "EQUIRECTANGULAR"
FINER = 2  # times feature_size: a panorama covers four times the field of view of a photograph
_SMALL = (512, 256)  # px; size at which edges are compared, to average out noise and compression
_STEP, _LEVELS = 3.0, 2.0  # largest difference across the seam: factor of that between columns, plus grey levels
_ONE_COLOUR = 0.5  # of the spread of middle rows: largest spread of the top row, which is a single direction
_DARK, _DARK_MOST = 8, 0.5  # grey level, fraction of the seam: two fisheye circles side by side meet in black


def meets_itself(image: np.ndarray) -> bool:
    """Whether an image shows a whole sphere: its left and right edges fit together, and its top row has one colour.

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
