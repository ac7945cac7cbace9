"""Close depth maps where photographs have no texture, as far as several views agree.

A plane sweep finds no depth on bare walls and table tops. Between known pixels, the inverse depth of a plane is an
affine function of the pixel, which interpolation by a Laplace equation restores exactly; edges of the photograph, where
surfaces end, hardly conduct. The result is only a guess, so a point is used where the closed depth maps of neighbouring
views agree on it and no view sees through it. Formulas: docs/math.md, "Dense start".
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

EDGE = 0.02  # colour difference of neighbouring pixels, [0, 1], at which conduction falls to 1 / e; noise is below
LEAK = 1e-3  # conduction across the strongest edge: each pixel that is connected to a known one gets a value


def closed_depth(depth: np.ndarray, known: np.ndarray, color: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Interpolate the unknown depths of a view.

    Parameters
    ----------
    depth : ndarray [H, W] world units
        Along the optical axis.
    known : ndarray [H, W] bool
        Pixels that keep their depth.
    color : ndarray [H, W, 3] in [0, 1]
    usable : ndarray [H, W] bool
        False for masked pixels, which conduct nothing.

    Returns
    -------
    ndarray [H, W] world units
        0 where no known pixel is connected.
    """
    links, fixed = _links(color, usable), known.ravel()
    laplace = csr_array(diags_array(np.asarray(links.sum(axis=1)).ravel()) - links)
    part = connected_components(links, directed=False)[1]
    free = np.isin(part, part[fixed]) & ~fixed
    closed = np.where(fixed, depth.ravel(), 0.0)
    if free.any():
        rows = laplace[free]
        closed[free] = 1 / spsolve(rows[:, free].tocsc(), -(rows[:, fixed] @ (1 / closed[fixed])))
    return np.asarray(closed.reshape(depth.shape))


def _links(color: np.ndarray, usable: np.ndarray) -> csr_array:
    """Return the conduction between neighbouring pixels, sparse and symmetric [HW, HW]."""
    count = usable.size
    index = np.arange(count).reshape(usable.shape)
    first, second, values = [], [], []
    for axis in (0, 1):
        change = np.abs(np.diff(color, axis=axis)).max(axis=2)
        a, b = (np.moveaxis(index, axis, 0)[part] for part in (slice(0, -1), slice(1, None)))
        both = usable.ravel()[a] & usable.ravel()[b]
        first.append(a.ravel())
        second.append(b.ravel())
        values.append((both * np.moveaxis(np.exp(-((change / EDGE) ** 2)) + LEAK, axis, 0)).ravel())
    i, j, v = map(np.concatenate, (first, second, values))
    i, j, v = i[v > 0], j[v > 0], v[v > 0]
    both_ways = np.concatenate([i, j]), np.concatenate([j, i])
    return csr_array(coo_array((np.concatenate([v, v]), both_ways), shape=(count, count)))


def enclosed(known: np.ndarray) -> np.ndarray:
    """Return the unknown pixels with known ones to the left, to the right, above and below, [H, W] bool.

    Others are extrapolated; the sky above a roof is one of them.
    """

    def before(image: np.ndarray, axis: int) -> np.ndarray:
        return np.asarray(np.logical_or.accumulate(image, axis=axis))

    ahead = before(known, 0) & before(known, 1)
    behind = before(known[::-1], 0)[::-1] & before(known[:, ::-1], 1)[:, ::-1]
    return np.asarray(ahead & behind & ~known)
