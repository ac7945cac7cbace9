"""What benchmarks/fog.py measures of a wall with a curtain before it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from benchmarks import fog

from gs2d.config.presets import two_dgs
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import Recipe
from gs2d.config.schedule import scale_schedule
from gs2d.data.scene import Scene
from gs2d.training.trainer import Trainer
from wall_scene import WALL, wall


def split() -> Scene:
    """The wall with its middle photograph held out."""
    views = wall().train
    return replace(wall(), train=(*views[:2], *views[3:]), test=views[2:3])


def recipe() -> Recipe:
    return scale_schedule(two_dgs(), 0.01)  # 300 iterations


def test_a_curtain_is_measured_as_hidden_points_and_near_weight() -> None:
    trainer = Trainer(split(), recipe(), GENERIC, backend="auto")
    trainer.run()
    before = fog.measure(split(), trainer)
    assert before["hidden"] < 0.02
    assert before["near_weight"] < 0.02
    splats = trainer.state.splats
    row = 0
    splats.means[row] = torch.tensor([0.0, 0.0, WALL / 3])
    splats.quats[row] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    splats.log_scales[row] = float(np.log(1.0))
    splats.opacity_logits[row] = 4.0
    after = fog.measure(split(), trainer)
    assert after["hidden"] > 0.7
    assert after["near_weight"] > 0.4


def test_the_command_trains_variants_and_writes_their_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fog, "load_scene", lambda path, downscale: split())
    out = tmp_path / "fog.json"
    threads = torch.get_num_threads()
    fog.main(["captures/wall:2", "--scale", "0.001", "--variants", "off", "robust", "no removal", "--out", str(out)])
    torch.set_num_threads(threads)
    rows = json.loads(out.read_text())
    assert [(row["capture"], row["downscale"], row["variant"]) for row in rows] == [
        ("wall", 2, variant) for variant in ("off", "robust", "no removal")
    ]
    assert all(np.isfinite(row["test"]["psnr"]) for row in rows)
    assert len({row["test"]["psnr"] for row in rows}) > 1
    assert "| wall | robust | " in capsys.readouterr().out


def test_a_capture_that_cannot_be_measured_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fog, "load_scene", lambda path, downscale: replace(split(), test=()))
    with pytest.raises(SystemExit, match="sparse"):
        fog.main(["captures/wall"])
