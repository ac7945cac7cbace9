"""The native plane sweep against torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.config.recipe import DenseStart
from gs2d.kernels.library import Library, available_variants, library_for
from gs2d.training.start import plane_sweep
from gs2d.training.start.plane_sweep import SmallView, Windows, best_planes, best_planes_reference, sweep_views
from wall_scene import WALL, wall

Z = 1 / torch.linspace(1 / 7.0, 1 / 2.5, 23)


@pytest.fixture(autouse=True)
def variant(native: Library, monkeypatch: pytest.MonkeyPatch) -> str:
    """Use each library in turn for the sweep."""
    monkeypatch.setenv("GS2D_CPU_VARIANT", native.variant)
    return native.variant


@pytest.fixture(scope="module")
def views() -> list[SmallView]:
    return list(sweep_views(wall(), DenseStart(side=48, min_angle=1.0)).views)


def windows(radius: int) -> Windows:
    return Windows(radius, noise=1e-4, texture=2e-5)


def assert_like(score: torch.Tensor, true: torch.Tensor, view: SmallView) -> None:
    """Compare float32 scores: a textureless patch has a variance of 1e-4 (noise), of which rounding is 1/1000."""
    torch.testing.assert_close(score, true, atol=3e-3, rtol=0)
    textured = plane_sweep._variance(view, 1)[0, 0] > 1e-3
    assert textured.float().mean() > 0.3
    torch.testing.assert_close(score[textured], true[textured], atol=2e-4, rtol=0)


@pytest.mark.parametrize(("others", "radius"), [((1,), 3), ((1, 3), 2), ((0, 1, 3, 4), 1), ((1, 3, 4), 7)])
def test_it_finds_the_planes_and_scores_that_torch_finds(
    views: list[SmallView], others: tuple[int, ...], radius: int
) -> None:
    beside = [views[k] for k in others]
    found, true = (
        best_planes(views[2], beside, Z, windows(radius)),
        best_planes_reference(views[2], beside, Z, windows(radius)),
    )
    assert_like(found.score, true.score, views[2])
    same, textured = found.plane == true.plane, plane_sweep._variance(views[2], radius)[0, 0] > 1e-3
    assert same[textured].float().mean() > 0.99
    inner = same & (true.plane > 0) & (true.plane < len(Z) - 1)
    assert inner.float().mean() > 0.4
    for name in ("before", "after"):
        torch.testing.assert_close(getattr(found, name)[inner], getattr(true, name)[inner], atol=2e-3, rtol=0)
    depth = Z[found.plane][(found.score > 0.9) & textured]
    assert float((depth / WALL - 1).abs().median()) < 0.05


def test_images_of_other_sizes_are_compared_and_pixels_outside_them_are_unknown(views: list[SmallView]) -> None:
    cut = replace(views[3], grey=views[3].grey[:, :, :20, :31].contiguous())
    found, true = best_planes(views[2], [cut], Z, windows(2)), best_planes_reference(views[2], [cut], Z, windows(2))
    assert_like(found.score, true.score, views[2])
    assert (found.score == -1).float().mean() > 0.1
    turned = views[3].T.copy()
    turned[:3] = np.diag([-1.0, 1.0, -1.0]) @ turned[:3]  # facing away
    away = replace(views[3], T=turned)
    assert (best_planes(views[2], [away], Z, windows(2)).score == -1).all()


def test_the_result_is_the_same_for_any_number_of_threads(views: list[SmallView]) -> None:
    tall = [replace(v, grey=v.grey.repeat(1, 1, 4, 1), usable=np.tile(v.usable, (4, 1))) for v in views]
    results = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            results.append(best_planes(tall[2], tall[3:], Z, windows(3)))
    finally:
        torch.set_num_threads(1)
    assert torch.equal(results[0].score, results[1].score)
    assert torch.equal(results[0].plane, results[1].plane)


def test_every_library_finds_the_same_bits(
    views: list[SmallView], variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = library_for(views[2].grey)
    assert library is not None
    assert library.variant == variant
    found = best_planes(views[2], views[3:], Z, windows(3))
    monkeypatch.setenv("GS2D_CPU_VARIANT", available_variants()[-1])
    other = best_planes(views[2], views[3:], Z, windows(3))
    for name in ("score", "plane", "before", "after"):
        assert torch.equal(getattr(found, name), getattr(other, name))
