"""The capture of scanned meshes: what stands where, and what is photographed of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from benchmarks.mesh_capture import build, main
from PIL import Image

from gs2d.data import load_scene


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


def test_the_capture_is_read_with_its_surface_beside_it(meshes: Path, tmp_path: Path) -> None:
    assert main([str(meshes), str(tmp_path / "out"), "--size", "32", "--train", "3", "--test", "1"]) == 0
    scene = load_scene(tmp_path / "out")
    assert (len(scene.train), len(scene.test)) == (3, 1)
    faces = len(build(meshes).patch.faces)
    assert np.load(tmp_path / "out" / "mesh_gt_seen.npy").shape == (faces,)
    pictures = np.stack([view.image() for view in scene.train])
    assert (pictures[..., 3] > 0).mean() > 0.1
