"""Fit the splats of a dense start to the photographs that see them: colour by least squares, opacity, size."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gs2d.config.robust import DenseStart, StartFit
from gs2d.core.sh import num_coefficients, sh_basis
from gs2d.core.splats import Splats
from gs2d.training.plane_sweep import SmallView, Sweep, project

AT_ONCE = 1 << 16  # splats whose equations are solved together


@torch.no_grad()
def fit_start(splats: Splats, sweep: Sweep, settings: DenseStart, kept: Tensor | None = None) -> Splats:
    """Return the splats with colour, opacity and size fitted to the views of a sweep (formulas: docs/math.md).

    A view sees a splat where its swept depth is that of the splat, to ``settings.agree``. Splats that none sees keep
    their colour.

    Parameters
    ----------
    splats : Splats
        Of :func:`gs2d.training.initialize.initial_splats`.
    sweep : Sweep
    settings : DenseStart
        With ``fit``.
    kept : Tensor [N] bool, optional
        Splats of sparse points apart from the swept ones: they keep their opacity, and their size up to
        ``fit.max_sparse_size``.
    """
    assert settings.fit is not None
    fit = settings.fit
    degree = min(fit.sh_degree, splats.sh_degree)
    places = splats.means.double().numpy()
    gram, right, seen, pixel = _equations(places, sweep, settings.agree, degree)
    colors = _solved(gram, right, fit).to(splats.sh0)
    seen_at_all = torch.from_numpy(seen > 0)
    sh0, shN = splats.sh0.clone(), splats.shN.clone()
    sh0[seen_at_all] = colors[seen_at_all, :1]
    shN[seen_at_all, : num_coefficients(degree) - 1] = colors[seen_at_all, 1:]
    of_pixel = torch.from_numpy(np.log(pixel)).to(splats.log_scales)[:, None]
    log_scales = torch.minimum(splats.log_scales + math.log(fit.size), of_pixel + math.log(fit.max_size))
    logits = torch.full_like(splats.opacity_logits, math.log(fit.opacity / (1 - fit.opacity)))
    if kept is not None:
        log_scales[kept] = torch.minimum(splats.log_scales, of_pixel + math.log(fit.max_sparse_size))[kept]
        logits[kept] = splats.opacity_logits[kept]
    return replace(splats, log_scales=log_scales, opacity_logits=logits, sh0=sh0, shN=shN)


def _equations(
    places: np.ndarray, sweep: Sweep, agree: float, degree: int
) -> tuple[Tensor, Tensor, np.ndarray, np.ndarray]:
    """Return the normal equations of the colours of places [N, 3], how many views see each, and its nearest pixel.

    Returns
    -------
    gram : Tensor [N, K, K] float64
        Sum over the views that see a place of b b^T, b its SH basis along the line of sight.
    right : Tensor [N, K, 3] float64
        Sum of b (colour - 1/2)^T.
    seen : ndarray [N] int
    pixel : ndarray [N] world units
        Size of a pixel there in the nearest view that shows it; infinite where none does.
    """
    count, K = len(places), num_coefficients(degree)
    gram, right = torch.zeros(count, K, K, dtype=torch.float64), torch.zeros(count, K, 3, dtype=torch.float64)
    seen, pixel = np.zeros(count, dtype=np.int64), np.full(count, np.inf)
    for view, depth in zip(sweep.views, sweep.depths, strict=True):
        z, column, row, inside = project(view, places)
        pixel = np.where(inside, np.minimum(pixel, z / view.K[0, 0]), pixel)
        found = depth[row, column]
        rows = np.flatnonzero(inside & (found > 0) & (np.abs(found - z) <= agree * z))
        if not len(rows):
            continue
        basis = sh_basis(torch.from_numpy(_directions(view, places[rows])), degree)  # [M, K]
        color = view.color[:, row[rows], column[rows]].double().T - 0.5  # [M, 3]
        at = torch.from_numpy(rows)
        gram.index_add_(0, at, basis[:, :, None] * basis[:, None, :])
        right.index_add_(0, at, basis[:, :, None] * color[:, None, :])
        seen[rows] += 1
    return gram, right, seen, pixel


def _directions(view: SmallView, places: np.ndarray) -> np.ndarray:
    """Return unit vectors [M, 3] from a view's camera to places."""
    center = -view.T[:3, :3].T @ view.T[:3, 3]
    rays = places - center
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _solved(gram: Tensor, right: Tensor, fit: StartFit) -> Tensor:
    """Return the coefficients [N, K, 3] of least squares; those above degree 0 with the ridge."""
    K = gram.shape[1]
    weight = torch.full((K,), fit.ridge / (4 * math.pi), dtype=gram.dtype)  # the mean square of a basis function
    weight[0] = 1e-9  # where nothing sees a splat there is still one solution
    damped = gram + torch.diag(weight)
    parts = [torch.linalg.solve(a, b) for a, b in zip(damped.split(AT_ONCE), right.split(AT_ONCE), strict=True)]
    return torch.cat(parts)
