"""Scores of splats over views: the quick mean PSNR of the training curve is that of the full scores."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gs2d.core.camera import look_at
from gs2d.core.splats import Splats
from gs2d.data.scene import View
from gs2d.evaluation.image_metrics import ImageMetrics
from gs2d.pipeline.finish.scoring import (
    CLEAR,
    SeenView,
    mean_psnr,
    score_views,
    transparent_entry,
    transparent_part,
)
from gs2d.render.backends import get_backend
from gs2d.render.types import RasterSettings


def test_the_mean_psnr_of_the_curve_is_that_of_the_full_scores_masks_and_equal_images_included() -> None:
    g = torch.Generator().manual_seed(0)
    splats = Splats(
        means=0.3 * torch.randn(6, 3, generator=g),
        quats=torch.randn(6, 4, generator=g),
        log_scales=torch.full((6, 2), -1.5),
        opacity_logits=torch.zeros(6),
        sh0=torch.randn(6, 1, 3, generator=g),
        shN=torch.zeros(6, 0, 3),
    )
    backend, settings = get_backend("reference"), RasterSettings(sh_degree=0)
    camera = look_at(np.array([0.0, 0.0, -3.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]), width=12, height=12, fx=14.0)
    away = look_at(
        np.array([0.0, 0.0, -3.0]), np.array([0, 0, -9.0]), np.array([0, -1.0, 0]), width=12, height=12, fx=14.0
    )
    noise = np.random.default_rng(0).integers(0, 256, (12, 12, 3), dtype=np.uint8)
    half = np.arange(12)[:, None].repeat(12, axis=1) < 6
    views = [
        View.from_arrays("noise", camera, noise),
        View.from_arrays("half", camera, noise, mask=half),
        View.from_arrays("nothing counts", camera, noise, mask=np.zeros((12, 12), bool)),
        View.from_arrays("equal: infinite", away, np.zeros((12, 12, 3), np.uint8)),
    ]
    scores = score_views(splats, views, settings, backend, name="", on_event=lambda event: None)
    values = [scores[name].psnr_float.value for name in ("noise", "half")]
    assert [scores[view.name].psnr_float.value for view in views[2:]] == [None, None]
    assert values[0] != values[1]
    assert mean_psnr(splats, views, settings, backend) == pytest.approx(sum(v for v in values if v) / 2, abs=0)
    assert mean_psnr(splats, views[2:], settings, backend) is None
    assert mean_psnr(splats, [], settings, backend) is None


def test_transparent_pixels_are_counted_where_photographs_are_opaque_and_unmasked() -> None:
    wall = Splats(
        means=torch.tensor([[-0.5, 0.0, 0.0]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.zeros(1, 2),
        opacity_logits=torch.full((1,), 9.0),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 0, 3),
    )
    camera = look_at(np.array([0.0, 0, -3]), np.zeros(3), np.array([0.0, -1, 0]), width=12, height=12, fx=14.0)
    grey, left = np.full((12, 12, 3), 90, np.uint8), np.arange(12)[None, :].repeat(12, axis=0) < 6
    alpha = np.concatenate([grey, np.full((12, 12, 1), 255, np.uint8)], axis=2)
    views = [
        View.from_arrays("all", camera, grey),
        View.from_arrays("left", camera, grey, mask=left),
        View.from_arrays("right", camera, grey, mask=~left),
        View.from_arrays("alpha", camera, alpha),
    ]
    parts: dict[str, float | None] = {}
    clear: list[torch.Tensor] = []

    def visit(seen: SeenView, _: ImageMetrics) -> None:
        parts[seen.view.name] = transparent_part(seen)
        clear.append(seen.output.alpha < CLEAR)

    settings = RasterSettings(sh_degree=0)
    score_views(wall, views, settings, get_backend("reference"), name="", on_event=lambda _: None, visitors=[visit])
    assert parts["alpha"] is None
    assert parts["all"] == pytest.approx(float(clear[0].float().mean()))
    assert parts["left"] == pytest.approx(float(clear[0][:, :6].float().mean()))
    found = {name: part for name, part in parts.items() if part is not None}
    assert found["left"] != found["right"]
    worst = max(found, key=found.__getitem__)
    entry = transparent_entry(found)["transparent"]
    assert (entry["view"], entry["worst"], entry["part"]) == (
        worst,
        found[worst],
        pytest.approx(np.mean([*found.values()])),
    )
    assert transparent_entry({}) == {}
