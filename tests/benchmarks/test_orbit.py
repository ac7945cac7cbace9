"""The orbit of the README: as many frames as requested, rendering and mesh of one size side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from benchmarks import orbit
from PIL import Image, ImageSequence

from ball_runs import options
from gs2d.pipeline.train.train_run import train
from tiny import write_capture


def test_an_orbit_has_its_frames_with_the_rendering_left_and_the_mesh_right(tmp_path: Path) -> None:
    train(options(write_capture(tmp_path / "ball", size=32), tmp_path / "run"))
    orbit.main([str(tmp_path / "run"), str(tmp_path / "orbit.webp"), "--frames", "3", "--size", "20", "24"])
    with Image.open(tmp_path / "orbit.webp") as image:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]
    assert [frame.shape for frame in frames] == [(24, 40, 3)] * 3
    assert all(frame[:, :20].std() > 1 for frame in frames)
