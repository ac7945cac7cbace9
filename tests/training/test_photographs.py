"""Whole panoramas and wide fisheyes in training, instead of their faces."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from capture_writers import opengl_camera_to_world, ring
from gs2d.config.presets import get_recipe, with_exposure, with_poses
from gs2d.config.protocols import GENERIC, get_protocol
from gs2d.config.schedule import fit_schedule
from gs2d.core.transforms import se3_exp
from gs2d.data import Scene, load_scene
from gs2d.data.faces import FACES
from gs2d.pipeline.finish.scoring import score_views
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.render.backends import get_backend
from gs2d.training import events
from gs2d.training.photographs import TrainedViews, needs_faces
from gs2d.training.trainer import Trainer

WIDTH, COUNT = 64, 4
LIKE = torch.zeros(())


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Return panoramas of noise, in all of which the lower quarter is masked."""
    root, noise = tmp_path_factory.mktemp("panoramas"), np.random.default_rng(0)
    frames = []
    for folder in ("images", "masks"):
        (root / folder).mkdir()
    for index, camera in enumerate(ring(COUNT)):
        pixels = noise.integers(0, 256, (WIDTH // 2, WIDTH, 3), np.uint8)
        Image.fromarray(pixels).save(root / f"images/{index}.png")
        mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
        mask[3 * WIDTH // 8 :] = 0
        mask[index] = 0
        Image.fromarray(mask).save(root / f"masks/{index}.png")
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": opengl_camera_to_world(camera)})
    (root / "transforms.json").write_text(json.dumps({"camera_model": "EQUIRECTANGULAR", "frames": frames}))
    return load_scene(root, test_every=0, masked="ignore")


def test_whole_photographs_have_the_pixels_of_their_files_and_the_rays_of_their_lens(scene: Scene) -> None:
    views = TrainedViews(scene.train, whole=True, masks=True, like=LIKE).views
    assert [view.name for view in views] == [f"images/{index}.png" for index in range(COUNT)]
    for view, camera in zip(views, ring(COUNT), strict=True):
        assert view.path is not None
        assert np.array_equal(view.image(), np.asarray(Image.open(view.path)))
        np.testing.assert_allclose(view.camera.T_cam_world, camera.T_cam_world, atol=1e-12)
        rays = view.camera.rays
        assert rays is not None
        row, column = 9, 40
        a, b = (column + 0.5 - 32) * 2 * np.pi / WIDTH, (row + 0.5 - 16) * 2 * np.pi / WIDTH  # b: down
        expected = [np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)]
        np.testing.assert_allclose(rays[row, column, :3], expected, atol=1e-6)
        hidden = (rays[..., :3] == 0).all(dim=2)
        assert hidden[24:].all()  # masked in all photographs
        assert not hidden[:24].any()
    assert all(view.camera.rays is None for view in TrainedViews(scene.train, whole=False, masks=True, like=LIKE).views)


def test_maps_of_faces_become_maps_of_the_photograph(scene: Scene) -> None:
    views, side = TrainedViews(scene.train, whole=True, masks=False, like=LIKE), 16
    maps = torch.arange(len(scene.train), dtype=torch.uint8)[:, None, None].expand(-1, side, side)
    names = [view.name for view in scene.train]
    for index in range(COUNT):
        of = {face: names.index(f"images/{index}_{face}.png") for face in FACES}
        cells = views.cells(maps, index)
        assert (
            cells[8].tolist()
            == [of["back"]] * 2 + [of["left"]] * 4 + [of["front"]] * 4 + [of["right"]] * 4 + [of["back"]] * 2
        )
        assert set(cells[0].tolist()) == {of["up"]}
        assert set(cells[-1].tolist()) == {of["down"]}
    quadrant = torch.zeros_like(maps)
    quadrant[names.index("images/0_front.png"), :8, :8] = 1  # up and to the left
    rows, columns = views.cells(quadrant, 0).nonzero().unbind(dim=1)
    assert set(columns.tolist()) == {6, 7}
    assert rows.max() == 7


def test_a_photograph_moves_with_its_faces(scene: Scene) -> None:
    motion = se3_exp(torch.tensor([0.02, -0.01, 0.03, 0.1, 0.2, -0.1], dtype=torch.float64)).numpy()
    moved = scene.with_poses({view.name: view.camera.T_cam_world @ motion for view in scene.train})
    for view, camera in zip(
        TrainedViews(moved.train, whole=True, masks=False, like=LIKE).views, ring(COUNT), strict=True
    ):
        np.testing.assert_allclose(view.camera.T_cam_world, camera.T_cam_world @ motion, atol=1e-12)


def test_training_needs_faces_for_what_rays_do_not_have(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe, cpu = get_recipe("best"), get_backend("reference")
    assert needs_faces(recipe, GENERIC, cpu) == ""
    assert needs_faces(with_exposure(recipe), GENERIC, cpu) == ""
    assert "poses is learned" in needs_faces(with_poses(recipe), GENERIC, cpu)
    assert "camera plane" in needs_faces(recipe, get_protocol("dtu"), cpu)
    monkeypatch.setattr(cpu, "takes_rays", False)
    assert "pinhole images only" in needs_faces(recipe, GENERIC, cpu)


def test_training_draws_whole_photographs(scene: Scene) -> None:
    recipe = fit_schedule(with_exposure(get_recipe("best")), 4 * COUNT)
    recipe = replace(recipe, init_points=200, dense_start=None)
    happened: list[events.TrainingEvent] = []
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", on_event=happened.append)
    trainer.enter(0)
    trainer.step()
    assert len(trainer.state.queue) == COUNT - 1  # an epoch has the photographs, not their faces
    trainer.run()
    losses = [event.losses["l1"] for event in happened if isinstance(event, events.Progress)]
    assert losses[-1] < 0.9 * losses[0]
    faces = trainer.scene_now().train
    assert len(faces) == len(scene.train)
    shown = Trained(trainer.splats, trainer.scene_now(), GENERIC, trainer.settings, trainer.backend, recipe)
    visited: list[str] = []
    scores = score_views(
        shown, faces, lambda event: None, split="test", visitors=[lambda pair, _: visited.append(pair.view.name)]
    )
    assert list(scores) == [f"images/{index}.png" for index in range(COUNT)]
    assert visited == [view.name for view in faces]
    exposures = {view.appearance["exposure"].tobytes(): view.whole for view in faces}
    assert list(exposures.values()) == [view.whole for view in faces[:: len(FACES)]]
