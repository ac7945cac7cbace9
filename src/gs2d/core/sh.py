"""Real spherical harmonics up to degree 3: view-dependent colour of a splat (docs/math.md, "Colour")."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from torch import Tensor

from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError

MAX_DEGREE = 3

# Normalisation constants of the real spherical harmonics (Condon-Shortley phase), as in 3DGS:
C0 = 0.28209479177387814  # sqrt(1 / (4 pi))
C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)  # sqrt(15 / 4pi), sqrt(5 / 16pi), sqrt(15 / 16pi)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
# sqrt(35 / 32pi), sqrt(105 / 4pi), sqrt(21 / 32pi), sqrt(7 / 16pi), sqrt(105 / 16pi)


def num_coefficients(degree: int) -> int:
    """K = (degree + 1)^2, the number of coefficients of all degrees up to ``degree``."""
    return (degree + 1) ** 2


def sh_degree_of(coefficients: int) -> int:
    """Return the SH degree with K coefficients; ShapeError if K is not 1, 4, 9 or 16."""
    for degree in range(MAX_DEGREE + 1):
        if num_coefficients(degree) == coefficients:
            return degree
    raise ShapeError(
        f"sh0 and shN must hold K = 1, 4, 9 or 16 SH coefficients (degree 0 to {MAX_DEGREE}), got {coefficients}"
    )


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Return the values [N, K] of the first K = (degree + 1)^2 basis functions along unit vectors [N, 3].

    They are ordered by degree l, then by order m = -l .. l. Raises ShapeError if the shape is wrong or the degree is
    not 0 to 3.
    """
    check_shapes({"directions": (directions, "N 3")})
    if not 0 <= degree <= MAX_DEGREE:
        raise ShapeError(f"SH degree must be 0 to {MAX_DEGREE}, got {degree}")
    x, y, z = directions.unbind(1)  # [N] each
    basis = [torch.full_like(x, C0), *harmonics(x, y, z, degree)]
    return torch.stack(basis, dim=1)


def harmonics(x: Any, y: Any, z: Any, degree: int) -> list[Any]:
    """Evaluate the basis functions of degrees 1 to ``degree`` at unit vectors (x, y, z) of one shape."""
    basis = []
    if degree >= 1:
        basis += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        basis += [
            C2[0] * x * y,
            -C2[0] * y * z,
            C2[1] * (2 * z * z - x * x - y * y),
            -C2[0] * x * z,
            C2[2] * (x * x - y * y),
        ]
    if degree >= 3:
        basis += [
            -C3[0] * y * (3 * x * x - y * y),
            C3[1] * x * y * z,
            -C3[2] * y * (4 * z * z - x * x - y * y),
            C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -C3[2] * x * (4 * z * z - x * x - y * y),
            C3[4] * z * (x * x - y * y),
            -C3[0] * x * (x * x - 3 * y * y),
        ]
    return basis


@cache
@torch.enable_grad()
def turns_of_harmonics(degree: int) -> Tensor:
    """Return L [3, K-1, K-1] float64, the derivative of the harmonics of degrees 1 to ``degree`` by a rotation.

    Y_k(g + w x g) = Y_k(g) + sum over axes a and harmonics j of w_a L_akj Y_j(g), for small w. Harmonics of one degree
    map to each other. L is fitted and then rounded: the squares of all entries are multiples of 1/4.
    """
    count = num_coefficients(degree) - 1
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(10 * count, 3, generator=generator, dtype=torch.float64)
    directions = (directions / directions.norm(dim=1, keepdim=True)).requires_grad_()
    basis = sh_basis(directions, degree)[:, 1:]
    changes = []
    for k in range(count):
        (slope,) = torch.autograd.grad(basis[:, k].sum(), directions, retain_graph=True)
        changes.append(torch.linalg.cross(directions.detach(), slope))
    derivatives = torch.stack(changes, dim=2).flatten(1)  # [10 (K-1), 3 (K-1)]
    turns = torch.linalg.lstsq(basis.detach(), derivatives).solution.T.reshape(3, count, count)
    return turns.sign() * ((4 * turns * turns).round() / 4).sqrt()


def sh_to_rgb(sh0: Tensor, shN: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Return the colour [N, 3] of N splats along N directions: SH + 0.5, clamped at 0 (not above 1).

    ``sh0`` is [N, 1, 3], ``shN`` [N, K-1, 3], and the unit vectors [N, 3] point from the camera to the splat.
    Coefficients above ``degree`` are ignored. A clamped channel has zero gradient. Raises ShapeError if the
    coefficients do not reach ``degree``.
    """
    check_shapes({"sh0": (sh0, "N 1 3"), "shN": (shN, "N _ 3"), "directions": (directions, "N 3")})
    K = num_coefficients(degree)
    if 1 + shN.shape[1] < K:
        raise ShapeError(f"shN must hold at least {K - 1} coefficients for degree {degree}, got {shN.shape[1]}")
    basis = sh_basis(directions, degree)  # [N, K]
    rgb = basis[:, :1] * sh0[:, 0] + torch.einsum("nk,nkc->nc", basis[:, 1:], shN[:, : K - 1])
    return (rgb + 0.5).clamp(min=0.0)


def rgb_to_sh0(rgb: Tensor) -> Tensor:
    """Return the degree-0 SH coefficients of view-independent colours.

    Parameters
    ----------
    rgb : Tensor [N, 3]
        Colours, sRGB in [0, 1].

    Returns
    -------
    Tensor [N, 1, 3]
        ``sh0`` of Splats: (rgb - 0.5) * sqrt(4 pi).

    Raises
    ------
    ShapeError
        If ``rgb`` is not [N, 3].

    Examples
    --------
    >>> rgb_to_sh0(torch.tensor([[0.5, 0.5, 0.5]])).squeeze()
    tensor([0., 0., 0.])
    """
    check_shapes({"rgb": (rgb, "N 3")})
    return ((rgb - 0.5) / C0)[:, None, :]
