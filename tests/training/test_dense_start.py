"""Dense initialisation of images without sparse points: sweep range, resulting points, and splat fitting."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from gs2d.config.presets import two_dgs
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import DenseStart, Recipe
from gs2d.config.schedule import scale_schedule
from gs2d.core.camera import Camera, look_at
from gs2d.core.sh import sh_to_rgb
from gs2d.data.scene import Scene, View
from gs2d.errors import DataError
from gs2d.evaluation.image_metrics import psnr_float
from gs2d.pipeline.train.run_logger import start_text
from gs2d.render.api import rasterize
from gs2d.training.events import Initialised
from gs2d.training.start.plane_sweep import Sweep, sweep_views
from gs2d.training.start.start_fit import fit_start
from gs2d.training.start.start_points import start_points
from gs2d.training.start.sweep_range import sweep_range
from gs2d.training.trainer import Trainer
from tiny import RADIUS, ball_image
from wall_scene import WALL, wall

BALL = DenseStart(side=64, neighbours=3, cell=2.0)
PIXEL = 3.0 / 80  # world units at the centre of the ball
BOUNDS = np.array([[-1.2, -1.2, -1.2], [1.3, 1.2, 1.2]])


def turn(camera: Camera, angle: float) -> Camera:
    """Turn a camera about its vertical axis (radians), which shifts what it sees."""
    cos, sin = np.cos(angle), np.sin(angle)
    about_y = np.array([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 0], [0, 0, 0, 1]])
    return replace(camera, T_cam_world=about_y @ camera.T_cam_world)


@cache
def ball() -> Scene:
    """Return a mottled ball with an alpha channel, from a ring of cameras 12 degrees apart, without points."""
    views = []
    for i, turn in enumerate(np.radians(np.arange(0, 360, 12))):
        eye = 3.0 * np.array([np.cos(turn), np.sin(turn), 0.1])
        camera = look_at(eye, np.zeros(3), np.array([0.0, 0, 1]), width=64, height=64, fx=80.0)
        views.append(View.from_arrays(f"{i:02d}.png", camera, ball_image(camera)))
    return Scene("ball", "blender", tuple(views), (), None, 3.3, BOUNDS)


@cache
def swept_ball() -> Sweep:
    return sweep_views(ball(), BALL)


def pointless_wall() -> Scene:
    return replace(wall(), observe=None, points=None, bounds=np.array([[-1.5, -1.2, 3.0], [1.5, 1.2, 5.0]]))


# -- sweep range -----------------------------------------------------------------------------------------------------
def test_without_points_the_visual_hull_limits_the_sweep() -> None:
    found = sweep_range(ball())
    cell = float(np.linalg.norm(BOUNDS[1] - BOUNDS[0])) / 48
    for view in ball().train:
        distance = float(np.linalg.norm(view.camera.center))
        near, far = found.limits[view.name]
        assert distance - RADIUS - 4 * cell < near < distance - RADIUS
        assert distance + RADIUS < far < distance + 1.25 * RADIUS + 4 * cell  # the hull extends at the poles
    assert np.linalg.norm(found.observed.points, axis=1).max() < 1.3 * RADIUS + 2 * cell
    assert len(found.observed.points) <= 2 * 2000


def test_a_wall_is_swept_without_sparse_points() -> None:
    sweep = sweep_views(pointless_wall(), DenseStart(side=48, min_angle=1.0))
    depth = sweep.depths[2][:, 20:]
    assert (depth > 0).mean() > 0.8
    assert np.median(np.abs(depth[depth > 0] / WALL - 1)) < 0.02


# -- points ----------------------------------------------------------------------------------------------------------
def test_swept_points_lie_on_the_ball() -> None:
    cloud = start_points(ball(), swept_ball(), BALL)
    off = np.abs(np.linalg.norm(cloud.points, axis=1) - RADIUS)
    assert len(cloud) > 300
    assert np.median(off) < 1.1 * PIXEL
    assert np.percentile(off, 95) < 3.5 * PIXEL
    assert cloud.normals is not None
    outward = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    assert np.median(np.abs((cloud.normals * outward).sum(axis=1))) > 0.85
    for depth, view in zip(swept_ball().depths, ball().train, strict=True):
        alpha = view.alpha()
        assert alpha is not None
        assert not (depth > 0)[alpha < 0.5].any()


# -- splat fitting ---------------------------------------------------------------------------------------------------
def recipe(settings: DenseStart, iterations: int = 6) -> Recipe:
    made = scale_schedule(two_dgs(), iterations / 30_000)
    stage = replace(made.stages[0], densify=None, sh_interval=0)
    return replace(made, stages=(stage,), sh_degree=2, dense_start=settings)


def test_a_fitted_start_looks_more_like_the_photographs_than_an_unfitted_one() -> None:
    def likeness(settings: DenseStart) -> float:
        trainer = Trainer(ball(), recipe(settings), GENERIC, backend="auto")
        values = []
        for view in ball().train[::6]:
            image = rasterize(trainer.splats, view.camera, trainer.settings, backend=trainer.backend).color.detach()
            values.append(psnr_float(image, torch.from_numpy(view.target(trainer.settings.background).copy())))
        return float(np.mean(values))

    plain, fitted = likeness(BALL), likeness(replace(BALL, fit=True))
    assert fitted > plain + 1


def test_a_fitted_splat_has_the_colour_of_the_images_and_a_bounded_size(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("OPACITY", 0.7), ("SIZE", 0.5), ("MAX_SIZE", 1.5)):
        monkeypatch.setattr(f"gs2d.training.start.start_fit.{name}", value)
    plain = Trainer(ball(), recipe(BALL), GENERIC, backend="reference").splats
    fitted = fit_start(plain, swept_ball())
    assert torch.equal(fitted.means, plain.means)
    assert torch.equal(fitted.quats, plain.quats)
    torch.testing.assert_close(fitted.opacities, torch.full_like(fitted.opacities, 0.7))
    assert (fitted.scales <= 1.5 * 1.1 * PIXEL).all()
    small = plain.scales * 0.5 < 1.5 * 0.6 * PIXEL  # the nearest camera is at 1 - 1.1 x 0.8 / 3 of the distance
    assert small.float().mean() > 0.5
    torch.testing.assert_close(fitted.scales[small], 0.5 * plain.scales[small])
    shown = sh_to_rgb(fitted.sh0, fitted.shN, torch.nn.functional.normalize(-fitted.means, dim=1), 1)  # from outside
    true = 0.5 + 0.4 * fitted.means / RADIUS + 0.1 * torch.sin(9 * fitted.means)
    assert (shown - true).abs().median() < 0.03
    assert (fitted.shN == 0).all()


# -- in training ----------------------------------------------------------------------------------------------------
def test_a_resumed_training_does_not_sweep_again(monkeypatch: pytest.MonkeyPatch) -> None:
    made = recipe(replace(BALL, fit=True))
    whole = Trainer(ball(), made, GENERIC, backend="auto").run()
    first = Trainer(ball(), made, GENERIC, backend="auto")
    first.enter(0)
    for _ in range(4):
        first.step()
    state = type(first.state).from_state_dict(first.state.state_dict())
    monkeypatch.setattr("gs2d.training.robust.robustness.sweep_views", None)
    again = Trainer(ball(), made, GENERIC, backend="auto", state=state).run()
    assert all(torch.equal(a, b) for (_, a), (_, b) in zip(whole.items(), again.items(), strict=True))


# -- optional dense start --------------------------------------------------------------------------------------------
def unlike_anything() -> Scene:
    """Return images of noise, in which no two views agree."""
    noise = np.random.default_rng(0)
    views = [
        View.from_arrays(view.name, view.camera, noise.integers(0, 255, (64, 64, 3), dtype=np.uint8))
        for view in ball().train[:6]
    ]
    return replace(ball(), train=tuple(views))


@pytest.mark.parametrize("kind", ["noise", "alone"])
def test_an_optional_start_is_left_out_and_reported_if_no_depths_agree(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gs2d.training.start.plane_sweep.MIN_NCC", 0.99)
    scene = unlike_anything() if kind == "noise" else replace(ball(), train=ball().train[:1])
    wished = replace(BALL, fit=True, required=False)
    told: list[object] = []
    trainer = Trainer(scene, recipe(wished), GENERIC, backend="reference", on_event=told.append)
    trainer.enter(0)
    (start,) = [event for event in told if isinstance(event, Initialised)]
    assert start.source == "random"
    assert start.splats > 0
    assert "a plane sweep of ball" in start.lacks
    assert start_text(start).endswith(f"; no dense start: {start.lacks}")
    with pytest.raises(DataError, match="a plane sweep of ball"):
        Trainer(scene, recipe(replace(wished, required=True)), GENERIC, backend="reference")
