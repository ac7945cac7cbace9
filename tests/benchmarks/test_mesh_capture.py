"""The capture of scanned meshes: what stands where, and what is photographed of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from benchmarks.mesh_capture import build, main, read_patch
from PIL import Image

from gs2d.data import load_scene
from gs2d.synthetic.scene import FLOOR


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    """A ball, a ball with y up, and a box with a texture, under the names of the scans."""
    root = tmp_path / "meshes"
    for name in ("nefertiti", "stanford_bunny", "spot"):
        (root / name).mkdir(parents=True)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=40.0)
    ball.export(root / "nefertiti" / "nefertiti.obj")
    ball.export(root / "stanford_bunny" / "stanford-bunny.obj")
    box = trimesh.creation.box((1.0, 3.0, 1.0))
    uv = np.random.default_rng(0).random((len(box.vertices), 2))
    box.visual = trimesh.visual.TextureVisuals(uv=uv, image=Image.new("RGB", (8, 8)))
    box.export(root / "spot" / "spot.obj")
    Image.new("RGB", (8, 8), (200, 30, 30)).save(root / "spot" / "spot_texture.png")
    return root


def test_a_mesh_stands_on_the_plinth_upright_and_as_high_as_asked(meshes: Path) -> None:
    box = read_patch(meshes / "spot" / "spot.obj", 0.5, (0.2, -0.3), 0.0, "y")
    low, high = box.vertices.min(axis=0), box.vertices.max(axis=0)
    assert low[2] == pytest.approx(FLOOR)
    assert high - low == pytest.approx([0.5 / 3, 0.5 / 3, 0.5])  # three times as high as it is wide
    assert (low + high)[:2] / 2 == pytest.approx([0.2, -0.3])
    assert np.linalg.norm(box.normals, axis=1) == pytest.approx(1.0)


def test_what_has_no_texture_is_painted_around_its_middle_without_a_seam(meshes: Path) -> None:
    ball = read_patch(meshes / "nefertiti" / "nefertiti.obj", 1.0, (0.0, 0.0), 0.0, "z")
    along = ball.uvs[ball.faces]
    away_from_poles = np.abs(along[..., 1] - 0.5).max(axis=1) < 0.4  # there the angle says nothing
    assert np.ptp(along[away_from_poles, :, 0], axis=1).max() < 0.25
    assert ball.uvs.min() >= 0
    assert ball.uvs.max() < 1


def test_the_capture_is_read_with_its_surface_beside_it(meshes: Path, tmp_path: Path) -> None:
    assert main([str(meshes), str(tmp_path / "out"), "--size", "32", "--train", "3", "--test", "1"]) == 0
    scene = load_scene(tmp_path / "out")
    assert (len(scene.train), len(scene.test)) == (3, 1)
    faces = len(build(meshes).patch.faces)
    assert np.load(tmp_path / "out" / "mesh_gt_seen.npy").shape == (faces,)
    pictures = np.stack([view.image() for view in scene.train])
    assert (pictures[..., 3] > 0).mean() > 0.1


def test_a_folder_without_the_meshes_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path), str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith("error: ")
    assert not (tmp_path / "out").exists()
