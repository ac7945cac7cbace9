"""The georeference as a value and as JSON."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gs2d.contrib.survey.georeference import Georeference, Residual
from gs2d.core.sh import sh_to_rgb
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices, transform_splats


def georeference(**changes: Any) -> Georeference:
    turn = Rotation.from_euler("xyz", (10, 20, 30), degrees=True).as_matrix()
    known: dict[str, Any] = {
        **{"scale": 2.5, "rotation": turn, "translation": np.array([1.25, -3.5, 0.75])},
        **{"origin": np.array([1_234_567.0, 5_654_321.0, 412.0]), "method": "a test", "epsg": 32632},
        **{"geodetic": np.array([51.0, 9.0, 412.0]), "grid_scale": 0.9997},
        "residuals": (
            Residual("a", np.array([0.3, 0.0, 0.4]), "fitted"),
            Residual("b", np.array([0.0, 0.1, 0.0]), "check"),
        ),
    }
    return Georeference(**{**known, **changes})


def test_points_are_exact_a_million_metres_from_the_origin() -> None:
    g, points = georeference(), np.random.default_rng(0).normal(size=(1000, 3)) * 50
    world = g.to_world(points)
    assert np.abs(world).max() > 5e6
    assert np.abs((world - g.origin - g.translation) @ g.rotation / g.scale - points).max() < 1e-8
    assert np.abs(world - g.origin - g.to_local(points)).max() < 1e-8


def test_json_keeps_every_digit() -> None:
    g = georeference()
    again = Georeference.from_json(json.loads(json.dumps(g.to_json())))
    for name in ("rotation", "translation", "origin", "geodetic"):
        assert (getattr(again, name) == getattr(g, name)).all()
    assert (again.scale, again.epsg, again.grid_scale) == (g.scale, g.epsg, g.grid_scale)
    assert (again.rms(), again.rms("check")) == pytest.approx((0.5, 0.1))
    worst = again.worst()
    assert worst is not None
    assert worst.name == "a"


def splats(count: int = 50, seed: int = 0) -> Splats:
    g = torch.Generator().manual_seed(seed)
    return Splats(
        means=torch.randn(count, 3, generator=g),
        quats=torch.randn(count, 4, generator=g),
        log_scales=torch.randn(count, 2, generator=g) - 3,
        opacity_logits=torch.randn(count, generator=g),
        sh0=torch.randn(count, 1, 3, generator=g),
        shN=0.2 * torch.randn(count, 15, 3, generator=g),
    )


def test_transformed_splats_look_the_same_from_the_transformed_camera() -> None:
    s, R, t = splats(), Rotation.from_euler("xyz", (33, -71, 140), degrees=True).as_matrix(), np.array([4.0, -2.0, 9.0])
    moved = transform_splats(s, 2.5, R, t)
    turn = torch.from_numpy(R).float()
    assert torch.allclose(moved.means, 2.5 * s.means @ turn.T + torch.tensor(t).float(), atol=1e-5)
    assert torch.allclose(quats_to_matrices(moved.quats), turn @ quats_to_matrices(s.quats), atol=1e-5)
    assert torch.allclose(moved.scales, 2.5 * s.scales, rtol=1e-5)
    eye = torch.tensor([7.0, 1.0, -3.0])
    before = torch.nn.functional.normalize(s.means - eye, dim=1)
    after = torch.nn.functional.normalize(moved.means - (2.5 * turn @ eye + torch.tensor(t).float()), dim=1)
    seen = [sh_to_rgb(one.sh0, one.shN, along, 3) for one, along in ((s, before), (moved, after))]
    assert (seen[0] - sh_to_rgb(s.sh0, s.shN, after, 3)).abs().max() > 0.1  # the turn matters
    assert (seen[0] - seen[1]).abs().max() < 1e-5
