"""Find pixels that show the sky.

Training assigns an arbitrary depth to the sky, often that of an adjacent roof, on which neighbouring views agree. Depth
alone cannot distinguish such a sheet from a wall, but the image can: sky is smooth, has no sparse points, reaches the
border of the image, and is above the horizon. So are some ceilings: ``sky_distance.py`` tells them apart.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, binary_propagation, distance_transform_edt, label, uniform_filter

SIDE = 400  # px; images are downscaled to this longer side
FINE, RADIUS = 3, 3  # px there; texture is the difference between the means of 3x3 and of 7x7 pixels
SMOOTH = 2 / 255  # standard deviation of texture: above image noise, below plaster
APART = 1 / 20  # of the longer side: distance of seeds from sparse points, and of pixels from seeds
BESIDE = 1 / 100  # of the longer side: smallest distance of sky from a sparse point
LEAST = 0.03  # of the image: smallest area of sky
ALIKE = 0.05  # colour difference, [0, 1], up to which pixels at the edge of an area belong to it


def sky_pixels(image: np.ndarray, points: np.ndarray, above: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """Find large smooth areas without sparse points, above the horizon and at the border of an image, [H, W] bool.

    The image [H, W, 3] is float in [0, 1]; ``points`` [M, 2] px are projections of all sparse points; ``above`` [H, W]
    marks the rays that point above the horizon. ``valid`` [H, W] are pixels with content: undistortion may leave empty
    wedges, whose edges count as border.
    """
    factor = max(1, round(max(image.shape[:2]) / SIDE))
    shown = np.ones(image.shape[:2], bool) if valid is None else valid
    places = np.floor(np.asarray(points) / factor).astype(np.int64)
    high = shrunk(above, factor) == 1
    sky = _smooth_areas(shrunk(image, factor), places, high, shrunk(shown, factor) == 1) & high
    rows, columns = (
        np.minimum(np.arange(size) // factor, small - 1) for size, small in zip(image.shape[:2], sky.shape, strict=True)
    )
    return np.asarray(sky[np.ix_(rows, columns)])


def shrunk(image: np.ndarray, factor: int) -> np.ndarray:
    """Average blocks of [H, W, ...]; incomplete blocks at two sides are dropped."""
    height, width = (max(1, size // factor) for size in image.shape[:2])
    high, wide = (min(factor, size) for size in image.shape[:2])
    blocks = image[: height * high, : width * wide].reshape(height, high, width, wide, *image.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3)), np.float32)


def _smooth_areas(image: np.ndarray, points: np.ndarray, above: np.ndarray, valid: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    longest, window = max(height, width), 2 * RADIUS + 1
    if not valid.any():
        return valid
    if not valid.all():  # the edge of the valid area must not count as texture
        image = image[tuple(distance_transform_edt(~valid, return_distances=False, return_indices=True))]
    # of 3x3 means: image noise does not count
    detail = uniform_filter(image, (FINE, FINE, 1)) - uniform_filter(image, (window, window, 1))
    smooth = valid & above & (uniform_filter((detail * detail).max(axis=2), window) < SMOOTH**2)
    empty = np.ones((height, width), bool)
    empty[np.minimum(points[:, 1], height - 1), np.minimum(points[:, 0], width - 1)] = False
    distance = distance_transform_edt(empty)
    seeds = smooth & (distance > APART * longest)
    if not seeds.any():
        return seeds
    around = smooth & (distance > BESIDE * longest) & (distance_transform_edt(~seeds) <= APART * longest)
    return _with_seams(image, _large_at_rim(around, valid))


def _large_at_rim(mask: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Keep connected areas of a mask that are large and touch the border of the valid pixels."""
    areas, count = label(mask)
    inner = np.zeros_like(mask)
    inner[1:-1, 1:-1] = True
    kept = np.zeros(count + 1, bool)
    kept[areas[~inner | binary_dilation(~valid)]] = True
    kept &= np.bincount(areas.ravel(), minlength=count + 1) >= LEAST * mask.size
    kept[0] = False
    return np.asarray(kept[areas])


def _with_seams(image: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Grow areas up to their bounding edges, which the windows of the texture test do not reach."""
    if not areas.any():
        return areas
    distance, (rows, columns) = distance_transform_edt(~areas, return_indices=True)
    window = 2 * RADIUS - 1
    weight = np.maximum(uniform_filter(areas.astype(np.float32), window), 1e-6)[..., None]
    color = uniform_filter(image * areas[..., None], (window, window, 1)) / weight
    alike = np.abs(image - color[rows, columns]).max(axis=2) < ALIKE
    return np.asarray(binary_propagation(areas, mask=areas | (alike & (distance <= 3 * RADIUS))))
