"""Pixels that show the sky.

Training gives the sky some depth, because any depth explains it, and often that of the roof beside it: a sheet on whose
depth neighbouring views agree. Depth alone cannot tell such a sheet from a plain wall or a table, but a photograph can:
the sky is smooth, has no sparse points, reaches the rim of the image, and lies above the horizon.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, binary_propagation, distance_transform_edt, label, uniform_filter

SIDE = 400  # px, longer side to which images are shrunk
RADIUS = 3  # px there: texture is the difference from the mean of 7x7 pixels
SMOOTH = 2.5 / 255  # standard deviation of texture: above the noise of photographs, below plaster
APART = 1 / 20  # of the longer side: sky is seeded this far from every sparse point, and grows as far from a seed
BESIDE = 1 / 100  # of the longer side: nearer to a sparse point there is no sky
LEAST = 0.03  # of the image: smaller smooth areas belong to a thing
ALIKE = 0.05  # colour difference, [0, 1], up to which pixels at the edge of an area still belong to it


def sky_pixels(image: np.ndarray, points: np.ndarray, above: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """Find the large smooth areas above the horizon, at the rim of an image, in which no sparse point lies.

    Parameters
    ----------
    image : ndarray [H, W, 3] float in [0, 1]
    points : ndarray [M, 2] px
        Sparse points within the image, whether the image has a keypoint of them or not.
    above : ndarray [H, W] bool
        Pixels whose rays rise.
    valid : ndarray [H, W] bool, optional
        Where the image has content: undistortion may leave wedges. An area that touches a wedge is at the rim.

    Returns
    -------
    ndarray [H, W] bool
    """
    factor = max(1, round(max(image.shape[:2]) / SIDE))
    shown = np.ones(image.shape[:2], bool) if valid is None else valid
    places = np.floor(np.asarray(points) / factor).astype(np.int64)
    high = _shrunk(above, factor) == 1
    sky = _smooth_areas(_shrunk(image, factor), places, high, _shrunk(shown, factor) == 1) & high
    rows, columns = (
        np.minimum(np.arange(size) // factor, small - 1) for size, small in zip(image.shape[:2], sky.shape, strict=True)
    )
    return np.asarray(sky[np.ix_(rows, columns)])


def _shrunk(image: np.ndarray, factor: int) -> np.ndarray:
    """Return the mean of blocks of [H, W, ...]; what is left over at two sides is cut."""
    height, width = (max(1, size // factor) for size in image.shape[:2])
    high, wide = (min(factor, size) for size in image.shape[:2])
    blocks = image[: height * high, : width * wide].reshape(height, high, width, wide, *image.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3)), np.float32)


def _smooth_areas(image: np.ndarray, points: np.ndarray, above: np.ndarray, valid: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    longest, window = max(height, width), 2 * RADIUS + 1
    if not valid.any():
        return valid
    if not valid.all():  # the edge of what is known is no texture
        image = image[tuple(distance_transform_edt(~valid, return_distances=False, return_indices=True))]
    detail = image - uniform_filter(image, (window, window, 1))
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
    """Return the connected areas of a mask that are large and touch the rim of the valid pixels."""
    areas, count = label(mask)
    inner = np.zeros_like(mask)
    inner[1:-1, 1:-1] = True
    kept = np.zeros(count + 1, bool)
    kept[areas[~inner | binary_dilation(~valid)]] = True
    kept &= np.bincount(areas.ravel(), minlength=count + 1) >= LEAST * mask.size
    kept[0] = False
    return np.asarray(kept[areas])


def _with_seams(image: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Grow areas up to the edges that bound them: the windows of the texture test end before those."""
    if not areas.any():
        return areas
    distance, (rows, columns) = distance_transform_edt(~areas, return_indices=True)
    window = 2 * RADIUS - 1
    weight = np.maximum(uniform_filter(areas.astype(np.float32), window), 1e-6)[..., None]
    color = uniform_filter(image * areas[..., None], (window, window, 1)) / weight
    alike = np.abs(image - color[rows, columns]).max(axis=2) < ALIKE
    return np.asarray(binary_propagation(areas, mask=areas | (alike & (distance <= 3 * RADIUS))))
