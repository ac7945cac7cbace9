"""The scene container: shapes agree, activations, rows, copies."""

from __future__ import annotations

import pytest
import torch

from gs2d.core.splats import Splats
from gs2d.errors import ShapeError


def make(count: int = 3, K: int = 16) -> Splats:
    g = torch.Generator().manual_seed(0)
    shapes = ((3,), (4,), (2,), (), (1, 3), (K - 1, 3))
    return Splats(*[torch.randn(count, *shape, generator=g) for shape in shapes])


def test_rows_must_agree() -> None:
    parts = dict(make().items()) | {"quats": torch.zeros(4, 4)}
    with pytest.raises(ShapeError, match="quats"):
        Splats(**parts)


@pytest.mark.parametrize(("K", "degree"), [(1, 0), (4, 1), (9, 2), (16, 3)])
def test_the_degree_follows_from_the_coefficients(K: int, degree: int) -> None:
    assert make(K=K).sh_degree == degree


def test_detach_shares_storage_and_clone_does_not() -> None:
    splats = make()
    splats.means.requires_grad_()
    shared, copied = splats.detach(), splats.clone()
    assert not shared.means.requires_grad
    with torch.no_grad():
        splats.means.fill_(7)
    assert bool((shared.means == 7).all())
    assert not bool((copied.means == 7).any())


def test_rows_are_picked_by_mask_or_index() -> None:
    splats = make()
    mask = torch.tensor([True, False, True])
    assert torch.equal(splats.rows(mask).means, splats.means[[0, 2]])
    assert torch.equal(splats.rows(torch.tensor([2, 0])).shN, splats.shN[[2, 0]])
