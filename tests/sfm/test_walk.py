"""Initial pairs for forward motion, which need looser thresholds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gs2d.cli import run
from gs2d.data.readers.colmap import read_images
from room_photos import write_walk


def test_a_walk_straight_ahead_is_placed(colmap: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """COLMAP's default thresholds reject every pair. Focal length and depth share one unknown scale."""
    write_walk(tmp_path / "photos")
    out = tmp_path / "capture"
    assert (
        run(
            ["poses", str(tmp_path / "photos"), "--out", str(out), "--threads", "1", "--camera-model", "SIMPLE_PINHOLE"]
        )
        == 0
    )
    assert json.loads((out / "poses.json").read_text())["placed"] == 8
    images = sorted(read_images(out / "sparse" / "0", "bin"), key=lambda image: image.name)
    centers = np.stack([-image.T_cam_world[:3, :3].T @ image.T_cam_world[:3, 3] for image in images])
    steps = np.diff(centers, axis=0)
    ahead = np.stack([image.T_cam_world[2, :3] for image in images])  # viewing directions
    assert np.linalg.norm(steps, axis=1) == pytest.approx(np.linalg.norm(steps, axis=1).mean(), rel=0.15)
    assert (ahead[:-1] * steps / np.linalg.norm(steps, axis=1, keepdims=True)).sum(axis=1) == pytest.approx(1, abs=0.02)
    assert "cameras" in capsys.readouterr().err
