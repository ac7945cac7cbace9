"""Fit the splats of a dense start to the images that show them: colour by least squares, opacity and size."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gs2d.core.sh import C0
from gs2d.core.splats import Splats
from gs2d.training.start.plane_sweep import AGREE, Sweep, project

OPACITY = 0.5  # of every fitted splat
SIZE = 0.7  # standard deviation of a splat, in units of the mean distance to its three nearest neighbours
MAX_SIZE = 6.0  # px of the nearest view that shows a splat, so that isolated splats stay small
# The same for splats at sparse points apart from all swept points. They represent surroundings where no depths agree
# (bare tables, cloth), start as large as in 2DGS and must cover much.
MAX_SPARSE_SIZE = 24.0
_TINY = 1e-9  # keeps the equations of splats that no view shows solvable


@torch.no_grad()
def fit_start(splats: Splats, sweep: Sweep, sparse: Tensor | None = None) -> Splats:
    """Return the splats with colour, opacity and size fitted to the views of a sweep (formulas: docs/math.md).

    A view shows a splat if its swept depth is that of the splat, to ``AGREE``. Splats that no view shows keep their
    colour. ``sparse`` ([N] bool) are splats of sparse points far from the swept ones; they keep their opacity, and
    their size up to ``MAX_SPARSE_SIZE``.
    """
    sums, weights, pixel = _observations(splats.means.double().numpy(), sweep)
    sh0, shown = splats.sh0.clone(), weights > 0
    colors = sums / (weights[:, None] + _TINY)
    sh0[shown] = colors.to(sh0)[shown, None]
    of_pixel = torch.from_numpy(np.log(pixel)).to(splats.log_scales)[:, None]
    log_scales = torch.minimum(splats.log_scales + math.log(SIZE), of_pixel + math.log(MAX_SIZE))
    logits = torch.full_like(splats.opacity_logits, math.log(OPACITY / (1 - OPACITY)))
    if sparse is not None:
        log_scales[sparse] = torch.minimum(splats.log_scales, of_pixel + math.log(MAX_SPARSE_SIZE))[sparse]
        logits[sparse] = splats.opacity_logits[sparse]
    return replace(splats, log_scales=log_scales, opacity_logits=logits, sh0=sh0)


def _observations(means: np.ndarray, sweep: Sweep) -> tuple[Tensor, Tensor, np.ndarray]:
    """Return what the views of a sweep show of points [N, 3]: two sums over the views, and sizes of pixels.

    The sums, float64, are those of C0 (colour - 1/2) [N, 3] and of C0^2 [N] over the views that show a point. The size
    [N] (world units) is that of a pixel at the point in the nearest view whose image contains it; infinite where none
    does.
    """
    sums, weights = torch.zeros(len(means), 3, dtype=torch.float64), torch.zeros(len(means), dtype=torch.float64)
    pixel = np.full(len(means), np.inf)
    for view, depth in zip(sweep.views, sweep.depths, strict=True):
        z, column, row, inside = project(view, means)
        pixel = np.where(inside, np.minimum(pixel, z / view.K[0, 0]), pixel)
        swept = depth[row, column]
        rows = np.flatnonzero(inside & (swept > 0) & (np.abs(swept - z) <= AGREE * z))
        color = view.color[:, row[rows], column[rows]].double().T - 0.5  # [M, 3]
        sums[rows] += C0 * color
        weights[rows] += C0 * C0
    return sums, weights, pixel
