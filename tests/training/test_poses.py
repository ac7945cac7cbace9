"""Learned poses: single updates, the gauge, fixed quantities, resuming, and the gain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from benchmarks.perturbations import disturbed

from gs2d.config.presets import appearance, surface
from gs2d.config.protocols import GENERIC
from gs2d.config.quantities import POSES
from gs2d.config.recipe import LearningRates, Recipe
from gs2d.core.camera import look_at
from gs2d.core.transforms import common_motion, perturb_pose, se3_exp, similarity_motions
from gs2d.data.scene import Scene
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.training.cached_objective import CachedViews
from gs2d.training.learned.camera_pose import CameraPose
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from learned_rows import begun
from train_toys import SIZE, VIEWS, backends, make_scene, random_splats, short

needs_cpu = pytest.mark.skipif("cpu" not in backends(), reason="the native library is not built")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


def quick() -> Recipe:
    """Return ``short`` with poses active from the third iteration on."""
    return short().with_learned(replace(POSES, rate=1e-2, rate_final=1e-3, start=2, decay_steps=10))


def motions(quantity: CameraPose, values: torch.Tensor) -> torch.Tensor:
    return torch.stack([quantity.numbers(values, index) for index in range(len(values))])


# -- one update ---------------------------------------------------------------------------------------------------
def test_a_similarity_of_the_scene_is_no_camera_motion(scene: Scene) -> None:
    made, g = CameraPose(POSES, scene), torch.Generator().manual_seed(0)
    values = 1e-3 * torch.randn(VIEWS, 6, generator=g, dtype=torch.float64)
    before = motions(made, values)
    assert before.abs().max() > 1e-4
    J = similarity_motions(made.initial, made.extent)
    values += torch.from_numpy(J @ np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6, 0.7]))
    torch.testing.assert_close(motions(made, values), before, rtol=1e-9, atol=1e-12)
    units = np.array([1.0] * 3 + [made.extent] * 3)
    assert np.abs(common_motion(before.numpy() / units, J)).max() < 1e-12


@pytest.mark.parametrize("k", range(7))
def test_similarity_motions_keep_the_images(scene: Scene, k: int) -> None:
    # The scene moves together with each camera: x_cam is unchanged (or scaled with the scene).
    given, step, extent = CameraPose(POSES, scene).initial, 1e-6, 2.0
    middle = np.mean([view.camera.center for view in scene.train], axis=0)
    w, v, grow = np.eye(7)[k, :3] * step, np.eye(7)[k, 3:6] * step * extent, 1 + step * (k == 6)
    S = se3_exp(torch.tensor([*w, 0.0, 0.0, 0.0], dtype=torch.float64)).numpy()
    motions = similarity_motions(given, extent)[:, :, k] * step * np.array([1, 1, 1, extent, extent, extent])
    for view, motion in zip(scene.train, motions, strict=True):
        camera = view.camera
        now = perturb_pose(camera, torch.from_numpy(motion))
        expected = middle + v + grow * S[:3, :3] @ (camera.center - middle)
        np.testing.assert_allclose(now.center, expected, atol=1e-10)
        np.testing.assert_allclose(now.rotation, camera.rotation @ S[:3, :3].T, atol=1e-10)


def test_a_single_camera_does_not_move(scene: Scene) -> None:
    made = CameraPose(POSES, replace(scene, train=scene.train[:1]))
    pose = made.pose(torch.full((1, 6), 0.1, dtype=torch.float64), 0)
    torch.testing.assert_close(pose, torch.from_numpy(made.initial[0]))


def test_the_pose_gradient_is_that_of_the_loss(scene: Scene) -> None:
    recipe, found = short().with_learned(replace(POSES, start=0)), {}
    for backend in backends():
        dtype = torch.float64 if backend == "reference" else torch.float32
        state = TrainState(random_splats(40, seed=1, dtype=dtype), torch.Generator().manual_seed(0))
        trainer = Trainer(scene, recipe, GENERIC, backend=backend, state=begun(state, recipe, scene))
        trainer.enter(0)
        found[backend] = trainer._whole.evaluate(state, recipe.stages[0], 1, 2).learned["poses"]
        if backend != "reference":
            largest = float(found["reference"].abs().max())
            torch.testing.assert_close(found[backend], found["reference"], rtol=1e-3, atol=1e-3 * largest)
            continue
        step, whole, camera = 1e-6, trainer._whole, scene.train[2].camera
        for k, motion in enumerate(step * torch.eye(6, dtype=torch.float64)):
            values = []
            for sign in (1, -1):
                there = perturb_pose(camera, sign * motion * torch.tensor([1.0] * 3 + [scene.extent] * 3))
                output = rasterize(state.splats, there, whole.settings(recipe.stages[0], 1), backend=backend)
                terms = whole.differentiate(state, recipe.stages[0], 1, 2, there, output, {}).losses
                values.append(float(sum(terms.values())))
            slope = (values[0] - values[1]) / (2 * step)
            assert slope == pytest.approx(float(found[backend][k]), rel=1e-3, abs=1e-5)


# -- training -----------------------------------------------------------------------------------------------------
@needs_cpu
def test_cached_views_use_the_learned_cameras(scene: Scene) -> None:
    learned = Recipe(
        "colors", (replace(surface(), iterations=1), replace(appearance(k=20.0), iterations=3 * VIEWS)),
        learned=(POSES,),
    )  # fmt: skip
    state = TrainState(random_splats(90, seed=5), torch.Generator().manual_seed(0))
    state.stage = 1
    moved = torch.randn(VIEWS, 6, generator=state.generator, dtype=torch.float64)
    begun(state, learned, scene).learned["poses"].values += 0.02 * moved
    trainer = Trainer(scene, learned, GENERIC, backend="cpu", state=state)
    trainer.enter(1)
    stage = learned.stages[1]
    cached = CachedViews(trainer._whole, state, stage, 1 << 30)
    for index in range(VIEWS):
        a, b = (e.evaluate(state, stage, 1, index) for e in (cached, trainer._whole))
        assert a.losses == pytest.approx(b.losses, rel=1e-6)
        assert "poses" not in a.learned


def test_ranking_uses_the_learned_cameras(scene: Scene) -> None:
    backend, state = backends()[-1], TrainState(random_splats(40, seed=1), torch.Generator())
    begun(state, quick(), scene).learned["poses"].values += 0.05 * torch.eye(VIEWS, dtype=torch.float64)
    learning = Trainer(scene, quick(), GENERIC, backend=backend, state=state)
    there = learning.scene_now()
    plain = Trainer(there, short(), GENERIC, backend=backend, state=TrainState(state.splats, torch.Generator()))
    for a, b in zip(learning._errors_by_view(False), plain._errors_by_view(False), strict=True):
        assert torch.equal(a, b)
    for view, given in zip(there.train, scene.train, strict=True):
        assert not np.allclose(view.camera.T_cam_world, given.camera.T_cam_world, atol=1e-3)
        assert np.array_equal(view.image(), given.image())


def test_a_view_at_another_pose_keeps_its_image(scene: Scene) -> None:
    view = scene.train[0]
    there = view.at(scene.train[1].camera.T_cam_world)
    assert np.array_equal(there.image(), view.image())
    assert (there.name, there.camera.fx) == (view.name, view.camera.fx)
    assert scene.with_poses({"not there": np.eye(4)}).train == scene.train


# -- gain ---------------------------------------------------------------------------------------------------------
@needs_cpu
def test_poses_are_recovered_and_improve_new_views() -> None:
    truth, angles = random_splats(80, seed=3), 2.4 * np.arange(20)
    heights = np.linspace(-1.5, 1.5, 20)[np.argsort(np.sin(7 * angles))]
    cameras = [
        look_at(np.array([3 * np.cos(a), 3 * np.sin(a), z]), np.zeros(3), np.eye(3)[2], width=SIZE, height=SIZE, fx=30)
        for a, z in zip(angles, heights, strict=True)
    ]
    off = [*disturbed(cameras[:16], 0, degrees=4.0, fraction=0.04), *cameras[16:]]
    base = make_scene()
    views = []
    for k, (camera, said) in enumerate(zip(cameras, off, strict=True)):
        with torch.no_grad():
            color = rasterize(truth, camera, RasterSettings(), backend="cpu").color
        image = (color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        views.append(type(base.train[0]).from_arrays(f"{k:02d}.png", camera, image).at(said.T_cam_world))
    scene = replace(base, train=tuple(views[:16]), test=tuple(views[16:]))
    stage = replace(surface(), iterations=600, densify=None, sh_interval=300, lr=LearningRates(means_decay_steps=600))
    settings = replace(POSES, rate=3e-3, rate_final=1e-4, start=100, decay_steps=600)
    psnr, left = [], []
    for learned in ((), (settings,)):
        trainer = Trainer(scene, Recipe("one", (stage,), learned=learned, init_points=60), GENERIC, backend="cpu")
        splats = trainer.run()
        errors = []
        for view in scene.test:
            with torch.no_grad():
                color = rasterize(splats, view.camera, trainer.settings, backend="cpu").color
            errors.append(float((color - torch.from_numpy(view.target((0.0, 0.0, 0.0)))).square().mean()))
        psnr.append(-10 * np.log10(np.mean(errors)))
        now = trainer.scene_now().train
        grid = np.stack(np.meshgrid(*[[-0.5, 0.0, 0.5]] * 3), axis=-1).reshape(-1, 3)
        apart = [v.camera.project(grid)[0] - c.project(grid)[0] for v, c in zip(now, cameras, strict=False)]
        left.append(np.sqrt(np.mean(np.square(apart))))
    assert psnr[1] > psnr[0] + 0.4
    assert left[1] < 0.6 * left[0]
