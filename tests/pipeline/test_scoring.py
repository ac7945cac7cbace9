"""Scores of splats over views: the mean PSNR of the training curve equals that of the full scores."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from gs2d.config.protocols import GENERIC
from gs2d.core.camera import look_at
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene, View
from gs2d.pipeline.finish.run_verdict import Collector
from gs2d.pipeline.finish.scoring import mean_psnr, score_views
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.render.backends import get_backend
from gs2d.render.types import RasterSettings
from gs2d.training.events import ignore

NO_SCENE = cast(Scene, SimpleNamespace(observed=lambda **_: None))


def test_the_mean_psnr_of_the_curve_equals_that_of_the_full_scores() -> None:
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
    trained = Trained(splats, NO_SCENE, GENERIC, settings, backend)
    scores = score_views(trained, views, ignore)
    values = [scores[name].psnr_float.value for name in ("noise", "half")]
    assert [scores[view.name].psnr_float.value for view in views[2:]] == [None, None]
    assert values[0] != values[1]
    assert mean_psnr(trained, views) == pytest.approx(sum(v for v in values if v) / 2, abs=0)
    assert mean_psnr(trained, views[2:]) is None
    assert mean_psnr(trained, []) is None


def test_transparent_pixels_are_counted_where_training_photographs_are_opaque_and_unmasked() -> None:
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
        View.from_arrays("nothing counts", camera, grey, mask=np.zeros((12, 12), bool)),
        View.from_arrays("alpha", camera, alpha),
    ]
    settings, backend = RasterSettings(sh_degree=0), get_backend("reference")
    clear = (backend.rasterize(wall, camera, settings).alpha < 0.9).double()
    every, half = float(clear.mean()), float(clear[:, :6].mean())
    assert 0 < half != every
    for split in ("train", "test"):
        counter = Collector(NO_SCENE)
        score_views(
            Trained(wall, NO_SCENE, GENERIC, settings, backend), views, ignore, split=split, visitors=[counter.visit]
        )
        if split == "test":
            assert counter.transparent() == {}
            continue
        worst, view = max((every, "all"), (half, "left"))
        expected = {"part": pytest.approx((every + half) / 2), "view": view, "worst": pytest.approx(worst)}
        assert counter.transparent() == {"transparent": expected}
