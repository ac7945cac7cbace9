"""Mean change of each attribute of the splats per iteration, for the attribute figure of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices

SAMPLE = 2_000  # splats


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Evenly spaced splats after an iteration of a stage."""

    iteration: int
    rows: Tensor  # [n] int64
    splats: Splats  # [n]


def take_snapshot(splats: Splats, iteration: int) -> Snapshot:
    """Return a copy of at most ``SAMPLE`` evenly spaced splats."""
    rows = torch.arange(0, len(splats), max(1, -(-len(splats) // SAMPLE)), device=splats.device)
    return Snapshot(iteration, rows, splats.rows(rows))


@torch.no_grad()
def mean_changes(snapshot: Snapshot, splats: Splats, *, iterations: int, extent: float) -> dict[str, float]:
    """Return the mean change of each attribute per iteration, over the sampled splats.

    Parameters
    ----------
    snapshot : Snapshot
    splats : Splats
        The same splats, with the same rows, ``iterations`` later.
    iterations : int
    extent : float
        Of the scene, world units.

    Returns
    -------
    dict
        ``mean``: |change of mu| as a fraction of the extent; ``covariance``: Frobenius norm of the change of
        Sigma = s_u^2 t_u t_u' + s_v^2 t_v t_v' relative to that of Sigma; ``opacity``: |change of o|; ``sh``:
        Euclidean norm of the change of all SH coefficients.
    """
    before, after = snapshot.splats, splats.rows(snapshot.rows)
    sigma = _covariances(before)
    turned = (_covariances(after) - sigma).flatten(1).norm(dim=1) / sigma.flatten(1).norm(dim=1).clamp(min=1e-300)
    color = ((after.sh0 - before.sh0).square().sum((1, 2)) + (after.shN - before.shN).square().sum((1, 2))).sqrt()
    moved = {
        "mean": (after.means - before.means).norm(dim=1) / extent,
        "covariance": turned,
        "opacity": (after.opacities - before.opacities).abs(),
        "sh": color,
    }
    return {name: float(change.double().mean()) / iterations for name, change in moved.items()}


def _covariances(splats: Splats) -> Tensor:
    """Return Sigma [N, 3, 3], world units^2, in double precision: its changes are small."""
    axes = quats_to_matrices(splats.quats.double())[:, :, :2] * splats.scales.double()[:, None]
    # Not a matrix product, which torch on a GPU refuses with deterministic algorithms.
    return (axes[:, :, None] * axes[:, None]).sum(dim=3)
