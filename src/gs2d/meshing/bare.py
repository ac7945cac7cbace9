"""Pixels that show nothing which could be matched: sky, black cloth, a white desk, a bare wall.

Training gives them some depth all the same, because any depth explains them. In a mesh that is a wall which nobody
photographed: a sky behind the roofs that spires melt into, sheets around a statue.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, binary_propagation, distance_transform_edt, label, uniform_filter

SIDE = 400  # px, longer side of the pictures that are looked at
RADIUS = 3  # px there: texture is what differs from the mean of 7x7 pixels, in a window of as many
SMOOTH = 2.5 / 255  # standard deviation below which there is none: above the noise of photographs, not of plaster
APART = 1 / 20  # of the longer side: what is as far from every sparse point is bare, and what is as near to that
BESIDE = 1 / 100  # of the longer side: what is so near to a sparse point is not
LEAST = 0.03  # of the picture, and at its rim: smooth patches of a thing are smaller, or lie within it
ALIKE = 0.05  # difference of colour, [0, 1], by which the seam along an edge still belongs to a bare area


def bare_pixels(image: np.ndarray, points: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """Find the large smooth areas at the rim of a photograph in which no sparse point lies.

    Parameters
    ----------
    image : ndarray [H, W, 3] float in [0, 1]
    points : ndarray [M, 2] px
        Sparse points in the picture, whether the photograph was found to show them or not.
    valid : ndarray [H, W] bool, optional
        Where it shows anything: undistortion may leave wedges. What touches those is at the rim.

    Returns
    -------
    ndarray [H, W] bool
    """
    factor = max(1, round(max(image.shape[:2]) / SIDE))
    shown = np.ones(image.shape[:2], bool) if valid is None else valid
    places = np.floor(np.asarray(points) / factor).astype(np.int64)
    bare = _bare(_shrunk(image, factor), places, _shrunk(shown, factor) == 1)
    rows, columns = (
        np.minimum(np.arange(size) // factor, small - 1)
        for size, small in zip(image.shape[:2], bare.shape, strict=True)
    )
    return np.asarray(bare[np.ix_(rows, columns)])


def _shrunk(image: np.ndarray, factor: int) -> np.ndarray:
    """Return the mean of blocks of [H, W, ...]; what is left over at two sides is cut."""
    height, width = (max(1, size // factor) for size in image.shape[:2])
    high, wide = (min(factor, size) for size in image.shape[:2])
    blocks = image[: height * high, : width * wide].reshape(height, high, width, wide, *image.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3)), np.float32)


def _bare(image: np.ndarray, points: np.ndarray, valid: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    longest, window = max(height, width), 2 * RADIUS + 1
    if not valid.any():
        return valid
    if not valid.all():  # the edge of what is known is no texture
        image = image[tuple(distance_transform_edt(~valid, return_distances=False, return_indices=True))]
    detail = image - uniform_filter(image, (window, window, 1))
    smooth = valid & (uniform_filter((detail * detail).max(axis=2), window) < SMOOTH**2)
    empty = np.ones((height, width), bool)
    empty[np.minimum(points[:, 1], height - 1), np.minimum(points[:, 0], width - 1)] = False
    distance = distance_transform_edt(empty)
    seeds = smooth & (distance > APART * longest)
    if not seeds.any():
        return seeds
    around = smooth & (distance > BESIDE * longest) & (distance_transform_edt(~seeds) <= APART * longest)
    return _with_seams(image, _large_at_rim(around, valid))


def _large_at_rim(mask: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the connected areas of a mask that are large and touch the rim of what is known."""
    areas, count = label(mask)
    inner = np.zeros_like(mask)
    inner[1:-1, 1:-1] = True
    kept = np.zeros(count + 1, bool)
    kept[areas[~inner | binary_dilation(~valid)]] = True
    kept &= np.bincount(areas.ravel(), minlength=count + 1) >= LEAST * mask.size
    kept[0] = False
    return np.asarray(kept[areas])


def _with_seams(image: np.ndarray, bare: np.ndarray) -> np.ndarray:
    """Bare areas up to the edges that bound them: windows that look for texture end before those."""
    if not bare.any():
        return bare
    distance, (rows, columns) = distance_transform_edt(~bare, return_indices=True)
    window = 2 * RADIUS - 1
    weight = np.maximum(uniform_filter(bare.astype(np.float32), window), 1e-6)[..., None]
    color = uniform_filter(image * bare[..., None], (window, window, 1)) / weight
    alike = np.abs(image - color[rows, columns]).max(axis=2) < ALIKE
    return np.asarray(binary_propagation(bare, mask=bare | (alike & (distance <= 3 * RADIUS))))
