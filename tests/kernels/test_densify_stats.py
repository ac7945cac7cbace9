"""Native densification statistics against torch."""

from __future__ import annotations

import pytest
import torch

from gs2d.kernels.library import Library
from gs2d.render.cpu_backend import CpuBackend


@pytest.mark.parametrize("columns", [2, 4])
@pytest.mark.parametrize("n", [0, 1, 9, 20_003])
def test_seen_splats_get_the_norms_and_are_counted(any_native: Library, columns: int, n: int) -> None:
    g = torch.Generator().manual_seed(n)
    dtype = any_native.dtype
    signal = torch.randn(n, columns, generator=g).to(dtype)
    radii = torch.randint(0, 3, (n,), generator=g).to(dtype)  # a third of them is invisible
    sums = [torch.rand(n, generator=g).to(dtype) for _ in range(3)]
    before = [tensor.clone() for tensor in sums]
    CpuBackend(any_native).accumulate(*sums, signal, radii)
    seen = radii > 0
    norms = [signal[:, :2].norm(dim=1), signal[:, 2:].norm(dim=1) if columns == 4 else torch.zeros(n, dtype=dtype)]
    digits = 1e-6 if dtype == torch.float32 else 1e-14
    for found, start, added in zip(sums, before, (*norms, torch.ones(n, dtype=dtype)), strict=True):
        assert torch.equal(found[~seen], start[~seen])
        assert torch.allclose(found, start + torch.where(seen, added, 0.0).to(dtype), rtol=digits, atol=0)


def test_a_splats_bits_do_not_depend_on_its_row_nor_on_threads(native: Library) -> None:
    g = torch.Generator().manual_seed(0)
    signal, radii = torch.randn(20_003, 4, generator=g), torch.ones(20_003)
    results = []
    for threads, first in ((1, 0), (3, 0), (2, 5)):
        native.use_threads(threads)
        sums = [torch.zeros(20_003 - first) for _ in range(3)]
        CpuBackend(native).accumulate(*sums, signal[first:], radii[first:])
        results.append([tensor[5 - first :] for tensor in sums])
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))
