"""Spherical harmonics: orthonormal, colours by hand, clamped at zero."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.special import sph_harm_y

from gs2d.core.sh import num_coefficients, rgb_to_sh0, sh_basis, sh_degree_of, sh_to_rgb


def directions(count: int = 50) -> torch.Tensor:
    x = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return x / x.norm(dim=1, keepdim=True)


def test_the_basis_is_orthonormal_on_the_sphere() -> None:
    # Gauss-Legendre in cos(theta) and uniform in phi integrate products of degree 6 exactly.
    z, weight = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * 2 * np.pi / 16
    r = np.sqrt(1 - z**2)[:, None]
    points = np.stack([r * np.cos(phi), r * np.sin(phi), np.broadcast_to(z[:, None], (8, 16))], axis=-1).reshape(-1, 3)
    basis = sh_basis(torch.tensor(points), 3).numpy()
    weights = np.repeat(weight * 2 * np.pi / 16, 16)
    np.testing.assert_allclose(basis.T @ (weights[:, None] * basis), np.eye(16), atol=1e-12)


def test_the_basis_is_scipys_in_the_real_form_with_the_condon_shortley_phase() -> None:
    d = directions()
    theta, phi = np.arccos(d[:, 2].numpy()), np.arctan2(d[:, 1].numpy(), d[:, 0].numpy())
    basis = sh_basis(d, 3).numpy()
    k = 0
    for degree in range(4):
        for m in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(m), theta, phi)
            real = y.real if m == 0 else math.sqrt(2) * (y.real if m > 0 else y.imag)
            np.testing.assert_allclose(basis[:, k], real, atol=1e-12, err_msg=f"l={degree} m={m}")
            k += 1


def test_a_colour_becomes_a_degree_0_coefficient_and_back() -> None:
    rgb = torch.tensor([[0.0, 0.3, 1.0], [0.5, 0.9, 0.1]], dtype=torch.float64)
    sh0 = rgb_to_sh0(rgb)
    assert sh0.shape == (2, 1, 3)
    torch.testing.assert_close(sh_to_rgb(sh0, torch.zeros(2, 15, 3).double(), directions(2), 3), rgb)


def test_zero_coefficients_are_mid_grey_and_negative_light_is_black() -> None:
    sh0 = torch.tensor([[[0.0, -3.0, 3.0]]])
    rgb = sh_to_rgb(sh0, torch.zeros(1, 0, 3), torch.tensor([[0.0, 0.0, 1.0]]), 0)
    # 0.5 + 3 / (2 sqrt(pi)) = 1.346: not clamped above 1.
    torch.testing.assert_close(rgb, torch.tensor([[0.5, 0.0, 0.5 + 3 / (2 * math.sqrt(math.pi))]]))


def test_higher_coefficients_are_ignored_below_their_degree() -> None:
    g = torch.Generator().manual_seed(1)
    sh0, shN = torch.randn(5, 1, 3, generator=g), torch.randn(5, 15, 3, generator=g)
    d = directions(5).float()
    for degree in range(4):
        K = num_coefficients(degree)
        cut = sh_to_rgb(sh0, shN[:, : K - 1], d, degree)
        assert torch.equal(sh_to_rgb(sh0, shN, d, degree), cut)
        assert sh_degree_of(K) == degree
