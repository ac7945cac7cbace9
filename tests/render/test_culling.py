"""What is left out before a view is rendered elsewhere has no radius, no pixel and no error there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.culling import may_be_seen
from gs2d.render.types import NEAR_PLANE_POLICIES, RasterSettings


def scattered(count: int, seed: int) -> Splats:
    """Splats in and far around the view, of all sizes: many beside it, behind it, across the camera's plane."""
    g = torch.Generator().manual_seed(seed)
    return Splats(
        means=3 * torch.randn(count, 3, generator=g),
        quats=torch.randn(count, 4, generator=g),
        log_scales=-2.5 + 1.5 * torch.randn(count, 2, generator=g),
        opacity_logits=3 * torch.randn(count, generator=g),
        sh0=torch.randn(count, 1, 3, generator=g),
        shN=torch.zeros(count, 0, 3),
    )


def view(seed: int) -> Camera:
    """A camera amid them, with its principal point off the middle."""
    rng = np.random.default_rng(seed)
    camera = look_at(rng.normal(size=3), rng.normal(size=3), np.array([0.0, 0.0, 1.0]), width=40, height=28, fx=33.0)
    return replace(camera, cx=14.0 + 9 * rng.normal(), cy=11.0 + 6 * rng.normal())


@pytest.mark.parametrize("policy", NEAR_PLANE_POLICIES)
@pytest.mark.parametrize("seed", range(4))
def test_what_cannot_be_seen_has_no_radius_and_no_errors(policy: str, seed: int) -> None:
    splats, camera = scattered(600, seed), view(seed)
    settings = RasterSettings(near_plane_policy=policy)
    seen = may_be_seen(splats, camera, settings)
    with torch.no_grad():
        output = rasterize(splats, camera, settings, backend="reference")
        errors = splat_errors(splats, camera, torch.zeros(28, 40, 3), settings, backend="reference")
    assert not bool((output.radii[~seen] > 0).any())
    assert not bool((errors[~seen] > 0).any())
    assert 0.2 < float((~seen).float().mean()) < 0.95  # much is left out
    assert float((output.radii > 0).sum()) > 0.3 * float(seen.sum())  # and not too little
    with torch.no_grad():
        of_these = rasterize(splats.rows(seen), camera, settings, backend="reference")
    torch.testing.assert_close(of_these.color, output.color)


def test_far_from_the_origin_nothing_is_lost_to_rounding() -> None:
    """Places of a map's coordinates, rounded to some centimetres in float32, before a lens of a few degrees."""
    splats = scattered(4000, 1)
    far = np.array([412_345.0, 5_712_345.0, 87.0])
    splats.means = 0.3 * splats.means + torch.from_numpy(far).float()
    splats.log_scales = splats.log_scales - 5
    up = np.array([0.0, 0.0, 1.0])
    camera = look_at(far - [41.0, 37.0, -23.0], far, up, width=60, height=40, fx=9000.0)
    seen = may_be_seen(splats, camera, RasterSettings())
    for dtype in (torch.float32, torch.float64):  # by whichever arithmetic
        with torch.no_grad():
            radii = rasterize(splats.to(dtype=dtype), camera, RasterSettings(), backend="reference").radii
        assert not bool((radii[~seen] > 0).any())
        assert 10 < int((radii > 0).sum()) <= int(seen.sum())


def test_broken_splats_are_not_sent() -> None:
    splats = scattered(4, 0)
    splats.means[0, 0], splats.log_scales[1, 0] = float("nan"), float("nan")
    assert may_be_seen(splats, view(0), RasterSettings())[:2].tolist() == [False, False]
