"""Cameras adjusted to the depth maps of a plane sweep."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import torch

from gs2d.config.presets import two_dgs
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import DenseStart
from gs2d.config.schedule import scale_schedule
from gs2d.core.camera import look_at
from gs2d.core.transforms import common_motion, perturb_pose, se3_exp, similarity_motions
from gs2d.data.scene import PointCloud, Scene, View
from gs2d.training.start.camera_adjustment import _linear, _matched, _pixels, adjust_cameras, adjusted_poses
from gs2d.training.start.plane_sweep import Sweep, sweep_views
from gs2d.training.trainer import Trainer
from tiny import ball_image

SMALL = DenseStart(side=112, neighbours=4, cell=2.0, adjust=True)
FOCAL = 140.0


def speckled(points: np.ndarray) -> np.ndarray:
    """Return colours [..., 3] of points with detail of about 5 px."""
    rng = np.random.default_rng(5)
    waves, phases = rng.normal(size=(24, 3)) * 15, rng.uniform(0, 2 * np.pi, size=(24, 3))
    value = sum(np.sin((points @ wave)[..., None] + phase) for wave, phase in zip(waves, phases, strict=True))
    return np.asarray(0.5 + 0.4 * np.tanh(0.3 * value))


@cache
def ball() -> Scene:
    """Return a speckled ball from two half rings of cameras, 12 degrees apart."""
    views = []
    for ring, height in enumerate((-0.35, 0.35)):
        for i, turn in enumerate(np.radians(np.arange(0, 156, 12))):
            eye = 3.0 * np.array([np.cos(turn), np.sin(turn), height])
            camera = look_at(eye, np.zeros(3), np.array([0.0, 0, 1]), width=112, height=112, fx=FOCAL)
            views.append(View.from_arrays(f"{ring}{i:02d}.png", camera, ball_image(camera, speckled)))
    return Scene("ball", "blender", tuple(views), (), None, 3.3, np.array([[-1.2] * 3, [1.2] * 3]))


@cache
def disturbed(pixels: float = 0.4) -> tuple[Scene, np.ndarray]:
    """Return the ball from cameras whose errors are about ``pixels``, and the true poses [V, 4, 4]."""
    scene, rng = ball(), np.random.default_rng(0)
    motions = rng.normal(size=(len(scene.train), 6)) * 0.6 * pixels / FOCAL
    motions[:, 3:] *= 3.0  # the distance of the ball
    J = similarity_motions(poses_of(scene), 1.0)
    motions -= J @ common_motion(motions, J)  # which no photograph shows
    poses = {
        view.name: perturb_pose(view.camera, torch.from_numpy(motion)).T_cam_world
        for view, motion in zip(scene.train, motions, strict=True)
    }
    return scene.with_poses(poses), poses_of(scene)


def errors(scene: Scene, true: np.ndarray) -> np.ndarray:
    """Return how far the cameras of a scene show the surface from where they should, px [V]."""
    rng, found = np.random.default_rng(1), []
    for view, T in zip(scene.train, true, strict=True):
        truth = replace(view.camera, T_cam_world=T)
        points = rng.normal(size=(50, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        points = points[(points - truth.center) @ truth.forward < 2.8]  # those in front
        found.append(np.linalg.norm(view.camera.project(points)[0] - truth.project(points)[0], axis=1).mean())
    return np.array(found)


@cache
def adjusted() -> tuple[Scene, Sweep | None]:
    return adjust_cameras(disturbed()[0], SMALL)


def poses_of(scene: Scene) -> np.ndarray:
    return np.stack([view.camera.T_cam_world for view in scene.train])


def test_wrong_cameras_move_to_where_the_photographs_match() -> None:
    given, true = disturbed()
    scene, sweep = adjusted()
    before, after = errors(given, true), errors(scene, true)
    assert np.median(before) > 0.3
    assert np.median(after) < 0.5 * np.median(before)
    assert sweep is not None
    for view, swept in zip(scene.train, sweep.views, strict=True):
        assert np.array_equal(swept.T, view.camera.T_cam_world)  # swept again


def test_large_errors_need_several_rounds() -> None:
    given, true = disturbed(1.2)
    once = adjusted_poses(sweep_views(given, SMALL))
    assert once is not None
    first = given.with_poses({view.name: pose for view, pose in zip(given.train, once, strict=True)})
    after = np.median(errors(adjust_cameras(given, SMALL)[0], true))
    assert after < 0.9 * np.median(errors(first, true))
    assert after < 0.4 * np.median(errors(given, true))


def test_right_cameras_stay() -> None:
    scene, sweep = adjust_cameras(ball(), SMALL)
    assert scene is ball()
    assert sweep is not None
    assert sweep.neighbours == sweep_views(ball(), SMALL).neighbours


def test_a_capture_that_cannot_be_swept_stays() -> None:
    alone = replace(
        ball(), train=ball().train[:1], points=PointCloud(np.zeros((0, 3)), None, None), bounds=np.zeros((2, 3))
    )
    assert adjust_cameras(alone, SMALL) == (alone, None)


def test_exposure_and_white_noise_do_not_move_cameras() -> None:
    given, true = disturbed()
    rng = np.random.default_rng(2)
    views = []
    for view in given.train:
        image = view.image().astype(np.float64)
        image[..., :3] = image[..., :3] * rng.uniform(0.75, 1.0) + rng.normal(size=(*image.shape[:2], 3)) * 2
        views.append(View.from_arrays(view.name, view.camera, image.clip(0, 255).astype(np.uint8)))
    scene, _ = adjust_cameras(replace(given, train=tuple(views)), SMALL)
    assert np.median(errors(scene, true)) < 0.6 * np.median(errors(given, true))


def test_the_derivatives_are_those_of_the_predictions() -> None:
    sweep = sweep_views(ball(), SMALL)
    poses = np.stack([view.T for view in sweep.views]).astype(np.float64)
    pixels = _pixels(sweep, 0)
    match = _matched(sweep, 0, pixels, poses)[0]
    other, step = match.other, 1e-6

    def predicted(own: np.ndarray, there: np.ndarray, inverse: float) -> np.ndarray:
        moved = poses.copy()
        moved[0] = se3_exp(torch.from_numpy(own)).numpy() @ poses[0]
        moved[other] = se3_exp(torch.from_numpy(there)).numpy() @ poses[other]
        return -_linear(sweep.views[other], replace(pixels, inverse=pixels.inverse + inverse), 0, match, moved).errors

    linear = _linear(sweep.views[other], pixels, 0, match, poses)
    for k in range(6):
        unit = np.eye(6)[k] * step
        by_own = (predicted(unit, 0 * unit, 0) - predicted(-unit, 0 * unit, 0)) / (2 * step)
        by_other = (predicted(0 * unit, unit, 0) - predicted(0 * unit, -unit, 0)) / (2 * step)
        np.testing.assert_allclose(by_own, linear.by_own[:, :, k], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(by_other, linear.by_other[:, :, k], rtol=1e-4, atol=1e-4)
    none = np.zeros(6)
    by_inverse = (predicted(none, none, step) - predicted(none, none, -step)) / (2 * step)
    np.testing.assert_allclose(by_inverse, linear.by_inverse, rtol=1e-4, atol=1e-4)


def test_adjusted_poses_need_matches() -> None:
    """Without texture, no pixel is matched and the given cameras stay."""
    given, _ = disturbed()
    plain = []
    for view in given.train:
        image = view.image().copy()
        image[..., :3] = 128
        plain.append(View.from_arrays(view.name, view.camera, image))
    assert adjusted_poses(sweep_views(replace(given, train=tuple(plain)), SMALL)) is None


def test_training_and_its_continuation_use_the_adjusted_cameras() -> None:
    given, _ = disturbed()
    recipe = replace(scale_schedule(two_dgs(), 0.001), dense_start=SMALL)
    trainer = Trainer(given, recipe, GENERIC, backend="cpu")
    resumed = Trainer(given, recipe, GENERIC, backend="cpu", state=trainer.state)
    for found in (trainer.scene_now(), resumed.scene_now(), trainer.scene):
        assert np.array_equal(poses_of(found), poses_of(adjusted()[0]))
