"""Poses that are learned: updates by hand, the gauge, what stands still, resuming, what they are worth."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
import torch

from fake_backends import lacking
from gs2d.config.presets import appearance, surface
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import LearningRates, PoseRefinement, Recipe
from gs2d.core.camera import look_at
from gs2d.core.transforms import common_motion, perturb_pose, se3_exp, similarity_motions
from gs2d.data.scene import Scene
from gs2d.errors import DivergedError, RunError
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.synthetic.perturb_poses import disturbed
from gs2d.training import per_image
from gs2d.training.cached_objective import CachedViews
from gs2d.training.poses import Poses, pose_rate, pose_step
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from train_toys import SIZE, VIEWS, backends, make_scene, random_splats, same, short

needs_cpu = pytest.mark.skipif("cpu" not in backends(), reason="the native library is not built")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


def quick() -> Recipe:
    """``short`` with poses from its third iteration on."""
    return replace(short(), poses=PoseRefinement(rate=1e-2, rate_final=1e-3, start=2, decay_steps=10))


def poses(scene: Scene) -> Poses:
    return Poses.start([view.camera for view in scene.train], scene.extent)


def saved(trainer: Trainer) -> bytes:
    file = io.BytesIO()
    torch.save(trainer.state.state_dict(), file)
    return file.getvalue()


def reload(data: bytes) -> TrainState:
    return TrainState.from_state_dict(torch.load(io.BytesIO(data), weights_only=True))


# -- one update ---------------------------------------------------------------------------------------------------
def test_only_the_view_s_own_numbers_are_written_and_its_first_step_is_the_rate(scene: Scene) -> None:
    made = poses(scene)
    gradient = torch.tensor([1.0, -2.0, 3.0, -4.0, 5.0, 0.0], dtype=torch.float64)
    pose_step(made, 1, gradient, quick(), 0.1)
    assert made.offsets[1].tolist() == pytest.approx([-0.1, 0.1, -0.1, 0.1, -0.1, 0.0])
    assert not made.offsets[[0, 2, 3, 4, 5]].any()
    assert made.steps == [0, 1, 0, 0, 0, 0]


def test_what_a_similarity_of_the_scene_does_to_all_cameras_is_no_motion(scene: Scene) -> None:
    made, g = poses(scene), torch.Generator().manual_seed(0)
    made.offsets += 1e-3 * torch.randn(VIEWS, 6, generator=g, dtype=torch.float64)
    before = made.motions()
    assert before.abs().max() > 1e-4
    J = similarity_motions(made.given.numpy(), made.extent)
    made.offsets += torch.from_numpy(J @ np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6, 0.7]))
    torch.testing.assert_close(made.motions(), before, rtol=1e-9, atol=1e-12)
    units = np.array([1.0] * 3 + [made.extent] * 3)
    assert np.abs(common_motion(before.numpy() / units, J)).max() < 1e-12


@pytest.mark.parametrize("k", range(7))
def test_the_motions_by_a_similarity_are_those_of_cameras_that_keep_their_picture(scene: Scene, k: int) -> None:
    # The scene moves, and each camera with it: x_cam stays (scaled, where the scene grows).
    given, step, extent = poses(scene).given.numpy(), 1e-6, 2.0
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


def test_a_single_camera_stays_where_it_is(scene: Scene) -> None:
    made = Poses.start([scene.train[0].camera], 1.0)
    made.offsets += 0.1
    torch.testing.assert_close(made.pose(0), made.given[0])


def test_the_gradient_is_that_of_the_loss_by_a_motion(scene: Scene) -> None:
    recipe, found = replace(quick(), poses=PoseRefinement(start=0)), {}
    for backend in backends():
        dtype = torch.float64 if backend == "reference" else torch.float32
        state = TrainState(random_splats(40, seed=1, dtype=dtype), torch.Generator().manual_seed(0))
        state.poses = poses(scene)
        trainer = Trainer(scene, recipe, GENERIC, backend=backend, state=state)
        trainer.enter(0)
        found[backend] = trainer._whole.evaluate(state, recipe.stages[0], 1, 2).gradients["pose"]
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
                terms = whole.differentiate(state, recipe.stages[0], 1, 2, there, output, {})[0]
                values.append(float(sum(terms.values())))
            slope = (values[0] - values[1]) / (2 * step)
            assert slope == pytest.approx(float(found[backend][k]), rel=1e-3, abs=1e-5)


# -- where they learn ---------------------------------------------------------------------------------------------
def test_poses_learn_after_their_start_and_where_all_splats_move() -> None:
    recipe = quick()
    lr = [[pose_rate(recipe, k, i) for i in range(1, s.iterations + 1)] for k, s in enumerate(recipe.stages)]
    assert lr[0][:2] == [0, 0]
    assert all(a > b > 0 for a, b in zip(lr[0][2:], lr[0][3:], strict=False))
    assert not any(lr[1])  # appearance: only colours learn
    assert lr[2] == pytest.approx([1e-3] * 5)  # refine: at the final rate
    assert pose_rate(short(), 0, 5) == 0


def test_cameras_stand_still_while_colours_learn_and_the_cached_views_are_theirs(scene: Scene) -> None:
    trainer = Trainer(scene, quick(), GENERIC, backend=backends()[-1])
    kept = {}
    trainer._on_event = lambda event: (
        kept.setdefault((type(event).__name__, event.stage), trainer.state.poses.motions())
        if hasattr(event, "stage")
        else None
    )  # type: ignore[union-attr]
    trainer.run()
    assert kept["StageStarted", "surface"].abs().max() == 0
    assert kept["StageFinished", "surface"].abs().max() > 1e-3
    assert torch.equal(kept["StageStarted", "appearance"], kept["StageFinished", "appearance"])
    assert not torch.equal(kept["StageStarted", "refine"], kept["StageFinished", "refine"])


@needs_cpu
def test_cached_views_are_of_the_cameras_that_were_found(scene: Scene) -> None:
    learned = Recipe(
        "colors", (replace(surface(), iterations=1), replace(appearance(k=20.0), iterations=3 * VIEWS)),
        poses=PoseRefinement(),
    )  # fmt: skip
    state = TrainState(random_splats(90, seed=5), torch.Generator().manual_seed(0))
    state.stage, state.poses = 1, poses(scene)
    state.poses.offsets += 0.02 * torch.randn(VIEWS, 6, generator=state.generator, dtype=torch.float64)
    trainer = Trainer(scene, learned, GENERIC, backend="cpu", state=state)
    trainer.enter(1)
    stage = learned.stages[1]
    cached = CachedViews(trainer._whole, state, stage, 1 << 30)
    for index in range(VIEWS):
        a, b = (e.evaluate(state, stage, 1, index) for e in (cached, trainer._whole))
        assert a.losses == pytest.approx(b.losses, rel=1e-6)
        assert "pose" not in a.gradients


def test_errors_are_ranked_from_where_the_cameras_are(scene: Scene) -> None:
    away = {view.name: perturb_pose(view.camera, torch.full((6,), 0.05, dtype=torch.float64)) for view in scene.train}
    backend, state = backends()[-1], TrainState(random_splats(40, seed=1), torch.Generator())
    state.poses = poses(scene)
    state.poses.given = torch.from_numpy(np.stack([away[view.name].T_cam_world for view in scene.train]))
    learning = Trainer(scene, quick(), GENERIC, backend=backend, state=state)
    there = scene.with_poses({name: camera.T_cam_world for name, camera in away.items()})
    plain = Trainer(there, short(), GENERIC, backend=backend, state=TrainState(state.splats, torch.Generator()))
    for a, b in zip(learning._errors_by_view(False), plain._errors_by_view(False), strict=True):
        assert torch.equal(a, b)
    now = per_image.scene_now(state, scene)
    for view, other in zip(now.train, there.train, strict=True):
        np.testing.assert_allclose(view.camera.T_cam_world, other.camera.T_cam_world, atol=1e-12)
        assert view.image() is not None


def test_a_view_from_elsewhere_has_the_same_picture(scene: Scene) -> None:
    view = scene.train[0]
    there = view.at(scene.train[1].camera.T_cam_world)
    assert np.array_equal(there.image(), view.image())
    assert (there.name, there.camera.fx) == (view.name, view.camera.fx)
    assert scene.with_poses({"not there": np.eye(4)}).train == scene.train


# -- resuming, refusing -------------------------------------------------------------------------------------------
def test_resuming_from_any_event_gives_the_same_splats_and_poses(scene: Scene) -> None:
    recipe, backend = quick(), backends()[-1]
    kept: list[bytes] = []
    trainer = Trainer(
        scene, recipe, GENERIC, backend=backend, progress_every=1, on_event=lambda _: kept.append(saved(trainer))
    )
    end = trainer.run()
    assert trainer.state.poses is not None
    found = trainer.state.poses.motions()
    assert found.abs().max() > 1e-3
    for data in kept[:: 1 if backend == "cpu" else 5]:
        resumed = Trainer(scene, recipe, GENERIC, backend=backend, state=reload(data))
        assert same(resumed.run(), end)
        assert resumed.state.poses is not None
        assert torch.equal(resumed.state.poses.motions(), found)
        assert resumed.state.poses.steps == trainer.state.poses.steps


def test_bytes_do_not_depend_on_the_number_of_threads(scene: Scene) -> None:
    ends, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            trainer = Trainer(scene, quick(), GENERIC, backend=backends()[-1])
            ends.append((trainer.run(), trainer.state.poses.motions()))  # type: ignore[union-attr]
    finally:
        torch.set_num_threads(before)
    assert same(ends[0][0], ends[1][0])
    assert torch.equal(ends[0][1], ends[1][1])


def test_a_state_with_the_poses_of_other_views_or_none_is_refused(scene: Scene) -> None:
    state = TrainState(random_splats(5), torch.Generator())
    with pytest.raises(RunError, match="poses of 6 views, as recipe and scene say, got 0"):
        Trainer(scene, quick(), GENERIC, backend="reference", state=state)
    state.poses = poses(scene)
    with pytest.raises(RunError, match="poses of 0 views, as recipe and scene say, got 6"):
        Trainer(scene, short(), GENERIC, backend="reference", state=state)


def test_a_pose_that_is_not_finite_ends_training(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = replace(quick(), poses=PoseRefinement(start=0))
    trainer = Trainer(scene, recipe, GENERIC, backend=backends()[-1])
    trainer.enter(0)
    monkeypatch.setattr(Poses, "gradient", lambda *_: torch.full((6,), torch.nan))
    with pytest.raises(DivergedError, match="the gradient of pose is NaN or infinite"):
        trainer.step()
    assert trainer.state.poses is not None
    trainer.state.poses.offsets[0, 0] = torch.nan
    assert per_image.find_nonfinite(trainer.state) == "a pose"


def test_an_update_that_was_cancelled_on_the_device_changes_nothing(scene: Scene) -> None:
    state = TrainState(random_splats(5), torch.Generator())
    state.poses = poses(scene)
    gradients = {"pose": torch.ones(6, dtype=torch.float64)}
    per_image.update(state, quick(), 5, 1, gradients, lacking(1))
    assert state.poses.steps == [0] * VIEWS
    per_image.update(state, quick(), 5, 1, gradients, lacking(0))
    assert state.poses.steps == [0, 1, 0, 0, 0, 0]


# -- what they are worth ------------------------------------------------------------------------------------------
@needs_cpu
def test_cameras_that_are_off_are_found_and_new_views_gain() -> None:
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
    settings = PoseRefinement(rate=3e-3, rate_final=1e-4, start=100, decay_steps=600)
    psnr, left = [], []
    for learned in (None, settings):
        trainer = Trainer(scene, Recipe("one", (stage,), poses=learned, init_points=60), GENERIC, backend="cpu")
        splats = trainer.run()
        errors = []
        for view in scene.test:
            with torch.no_grad():
                color = rasterize(splats, view.camera, trainer.settings, backend="cpu").color
            errors.append(float((color - torch.from_numpy(view.target((0.0, 0.0, 0.0)))).square().mean()))
        psnr.append(-10 * np.log10(np.mean(errors)))
        now = per_image.scene_now(trainer.state, scene).train
        grid = np.stack(np.meshgrid(*[[-0.5, 0.0, 0.5]] * 3), axis=-1).reshape(-1, 3)
        apart = [v.camera.project(grid)[0] - c.project(grid)[0] for v, c in zip(now, cameras, strict=False)]
        left.append(np.sqrt(np.mean(np.square(apart))))
    assert psnr[1] > psnr[0] + 0.4
    assert left[1] < 0.6 * left[0]
