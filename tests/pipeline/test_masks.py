"""Masked pixels are ignored, and empty pixels are empty, from loading to the mesh."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from capture_writers import ColmapModel, ring, small_colmap
from gs2d.cli import run
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import LossTerm, Recipe, Stage
from gs2d.core.splats import Splats
from gs2d.data import load_scene
from gs2d.errors import DataError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.finish.run_subject import sights
from gs2d.pipeline.in_memory import Trained, evaluate, extract_mesh, train
from gs2d.pipeline.prepare.loaded import reload_run, scene_digest
from gs2d.pipeline.prepare.open_capture import without_masked_points
from gs2d.pipeline.prepare.options import MeshOptions, Training
from gs2d.render.backends import get_backend
from gs2d.training.events import Notice
from gs2d.training.trainer import raster_settings
from tiny import ball_cameras, ball_image

HALF = np.where(np.arange(24) < 12, 255, 0).astype(np.uint8)[None].repeat(24, axis=0)


def write_ball(root: Path, noise: int) -> Path:
    """The ball as a COLMAP capture, grey around it; its right half is masked, and there it shows noise."""
    model = ColmapModel(cameras={1: ("PINHOLE", 24, 24, (32.9, 32.9, 12.0, 12.0))})
    points = np.random.default_rng(5).normal(size=(200, 3))
    points *= 0.8 / np.linalg.norm(points, axis=1, keepdims=True)
    for index, camera in enumerate(ball_cameras(8)):
        rgba = ball_image(replace(camera, fx=32.9, fy=32.9))
        pixels = np.where(rgba[..., 3:] > 0, rgba[..., :3], 90).astype(np.uint8)
        pixels[:, 12:] = np.random.default_rng(noise + index).integers(0, 256, (24, 12, 3))
        (root / "images").mkdir(parents=True, exist_ok=True)
        (root / "masks").mkdir(exist_ok=True)
        Image.fromarray(pixels).save(root / "images" / f"{index}.png")
        Image.fromarray(HALF).save(root / "masks" / f"{index}.png.png")
        model.images.append((index + 1, camera.T_cam_world, 1, f"{index}.png", []))
    for index, point in enumerate(points):
        model.points.append((index + 1, point, (200, 100, 50), 0.5, []))
    model.write(root / "sparse/0")
    return root


def everything(root: Path, **options: Any) -> tuple[Splats, dict[str, Any], np.ndarray, np.ndarray]:
    recipe = Recipe("plain", (Stage("surface", 12, losses=(LossTerm("l1", 1.0),)),))
    trained = train(
        load_scene(root, test_every=4, **options),
        recipe,
        backend="cpu",
        options=Training(learn="exposure", robust="off"),
    )
    solid = replace(trained.splats, opacity_logits=trained.splats.opacity_logits + 9)
    mesh = extract_mesh(replace(trained, splats=solid), options=MeshOptions(whole_scene=True, voxel=0.1))
    votes = sights(trained)
    # SSIM looks at windows, which reach over the mask's edge on both sides alike.
    return trained.splats, {"psnr": evaluate(trained).psnr}, mesh.vertices, np.concatenate([s.points for s in votes])


def test_the_values_of_masked_pixels_do_not_matter(tmp_path: Path) -> None:
    first, second = (everything(write_ball(tmp_path / str(noise), noise)) for noise in (0, 100))
    for name, tensor in first[0].items():
        assert torch.equal(
            tensor, second[0].as_dict()[name] if hasattr(second[0], "as_dict") else dict(second[0].items())[name]
        )
    assert first[1] == second[1]
    assert len(first[2])
    assert np.array_equal(first[2], second[2])
    assert np.array_equal(first[3], second[3])
    seen, _, _, _ = everything(tmp_path / "0", masked="off")
    assert not torch.equal(seen.sh0, first[0].sh0)  # so the test can fail


def test_fusion_and_subject_ignore_masked_pixels(tmp_path: Path) -> None:
    scene = load_scene(write_ball(tmp_path, 0), test_every=0)
    splats = train(scene, Recipe("plain", (Stage("surface", 2, losses=(LossTerm("l1", 1.0),)),)), backend="cpu").splats
    opaque = replace(splats, opacity_logits=torch.full_like(splats.opacity_logits, 8.0))

    def job(protocol: Any) -> Trained:
        settings = raster_settings(protocol, scene.extent, 3)
        return Trained(opaque, scene, protocol, settings, get_backend("cpu"))

    from gs2d.pipeline.finish.run_mesh import fusion_frame

    view = scene.train[0]
    output = job(GENERIC).render(view.camera)
    assert (output.alpha > 0.9).any()
    kept = fusion_frame(job(GENERIC), view, output, "median").valid
    every = fusion_frame(job(replace(GENERIC, use_mask_in_fusion=False)), view, output, "median").valid
    assert every[:, 12:].any()
    assert not kept[:, 12:].any()
    assert np.array_equal(kept[:, :12], every[:, :12])
    for sight in sights(job(GENERIC)):
        pixels, _ = sight.camera.project(sight.points)
        assert (pixels[:, 0] < sight.camera.width / 2 + 1).all()
    without = replace(GENERIC, use_mask_in_training=False)
    assert any((s.camera.project(s.points)[0][:, 0] > s.camera.width / 2 + 1).any() for s in sights(job(without)))


def test_points_in_masked_pixels_only_are_not_used(tmp_path: Path) -> None:
    cameras = ring(3, width=24, height=24)
    model = ColmapModel(cameras={1: ("PINHOLE", 24, 24, (35.0, 35.0, 12.0, 12.0))})
    right = [camera.center + camera.forward * 4 + camera.rotation[0] * 0.8 for camera in cameras]
    left = [camera.center + camera.forward * 4 - camera.rotation[0] * 0.8 for camera in cameras]
    for index, camera in enumerate(cameras):
        seen = [(1.0, 1.0, index + 1), (1.0, 1.0, 4 + index), (1.0, 1.0, 7)]
        model.images.append((index + 1, camera.T_cam_world, 1, f"{index}.png", seen))
        (tmp_path / "images").mkdir(exist_ok=True)
        (tmp_path / "masks").mkdir(exist_ok=True)
        Image.fromarray(np.full((24, 24, 3), 90, np.uint8)).save(tmp_path / "images" / f"{index}.png")
        Image.fromarray(HALF).save(tmp_path / "masks" / f"{index}.png")
    for index, point in enumerate([*right, *left, np.array([0.3, 0.0, 0.0])]):
        model.points.append((index + 1, point, (200, 100, 50), 0.5, [(1, 0)]))
    model.write(tmp_path / "sparse/0")  # the last point lies left in one photograph, right in another
    said: list[Any] = []
    scene = without_masked_points(load_scene(tmp_path, test_every=0), GENERIC, said.append)
    assert scene.points is not None
    np.testing.assert_allclose(scene.points.points, [*left, np.array([0.3, 0, 0])])
    assert said == [Notice("3 of 7 sparse points are in masked pixels only: left out", detail=True)]
    scene = without_masked_points(load_scene(tmp_path, test_every=0, masked="off"), GENERIC, said.append)
    assert scene.points is not None
    assert len(scene.points) == 7


def test_empty_masks_are_reported_and_an_error_if_all_are_empty(tmp_path: Path) -> None:
    small_colmap(tmp_path)
    (tmp_path / "masks").mkdir()
    for count, words in ((1, "masks of 1 of 9 views leave no pixel, first 0.png"), (9, "are the masks inverted")):
        for index in range(count):
            Image.fromarray(np.zeros((30, 40), np.uint8)).save(tmp_path / "masks" / f"{index}.png")
        for masked in ("ignore", "empty"):
            scene, said = load_scene(tmp_path, masked=masked), list[Any]()
            if count == 9:
                with pytest.raises(DataError, match=words):
                    scene_digest(scene, said.append, uses_masks=True)
            else:
                scene_digest(scene, said.append, uses_masks=True)
                assert any(words in getattr(event, "text", "") for event in said)


def test_a_run_remembers_its_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_ball(tmp_path / "capture", 0)
    (root / "masks").rename(tmp_path / "mine")
    words = ["train", str(root), "--out", str(tmp_path / "run"), "--recipe", "2dgs", "--schedule-scale", "0.0005"]
    words += ["--set", "init_points=60", "--quiet", "--set", "page=false", "--masks", str(tmp_path / "mine")]
    assert run([*words, "--masked", "empty"]) in (0, 3)  # 3: there is no surface yet
    data = json.loads((tmp_path / "run" / "run.json").read_text())
    assert data["scene"]["masks"] == {"folder": str(tmp_path / "mine"), "masked": "empty", "found": 8}
    scene = reload_run(RunFolder(tmp_path / "run"), lambda _: None).scene
    assert scene.masks.found == 8
    assert scene.train[0].alpha() is not None
    capsys.readouterr()
    assert run([*words, "--masked", "ignore", "--resume"]) == 2
    assert "another" in capsys.readouterr().err
