"""``gs2d.train``, ``gs2d.evaluate`` and ``gs2d.extract_mesh`` do what the commands do, without a folder."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gs2d
from ball_runs import SCALE, SMALL
from gs2d.errors import DataError, RecipeError
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.in_memory import Trained
from gs2d.pipeline.prepare.options import MeshOptions


@pytest.fixture(scope="module")
def trained(capture: Path) -> Trained:
    """What ``undisturbed`` is, in memory."""
    return gs2d.train(gs2d.load_scene(capture), "2dgs-r", schedule_scale=SCALE, options=gs2d.Training(overrides=SMALL))


def test_training_in_memory_gives_the_bytes_of_a_run(trained: Trained, undisturbed: RunFolder, tmp_path: Path) -> None:
    gs2d.write_splats(tmp_path / "splats.ply", trained.splats)
    assert (tmp_path / "splats.ply").read_bytes() == undisturbed.file("splats.ply").read_bytes()


def test_scores_in_memory_equal_those_of_the_run(trained: Trained, undisturbed: RunFolder) -> None:
    entry = undisturbed.metrics()["stages"][-1]
    for split in ("test", "train"):
        assert gs2d.evaluate(trained, split=split).to_json() == entry[split]


def test_the_mesh_in_memory_equals_that_of_the_run(trained: Trained, undisturbed: RunFolder) -> None:
    ours, theirs = gs2d.extract_mesh(trained), read_mesh(undisturbed.file("mesh.ply"))
    assert len(ours.faces) > 0
    assert np.array_equal(ours.faces, theirs.faces)
    assert np.array_equal(np.float32(ours.vertices), np.float32(theirs.vertices))


def test_splats_from_a_file_are_scored_and_meshed_with_their_scene(trained: Trained, undisturbed: RunFolder) -> None:
    splats = gs2d.read_splats(undisturbed.file("splats.ply"))
    with pytest.raises(DataError, match="splats"):
        gs2d.evaluate(splats)
    with pytest.raises(DataError, match="has a scene of its own"):
        gs2d.evaluate(trained, trained.scene)
    assert gs2d.evaluate(splats, trained.scene, backend="cpu") == gs2d.evaluate(trained)
    options = MeshOptions(bbox=(-1.0, -1.0, 0.0, 1.0, 1.0, 1.0))
    half = gs2d.extract_mesh(splats, trained.scene, backend="cpu", options=options)
    assert half.vertices[:, 2].min() >= -1e-6


def test_invalid_arguments_are_errors_before_training(trained: Trained) -> None:
    scene = trained.scene
    with pytest.raises(RecipeError, match="no recipe '2dgz'"):
        gs2d.train(scene, "2dgz")
    with pytest.raises(DataError, match="split"):
        gs2d.evaluate(trained, split="val")


def test_iterations_set_the_length_and_progress_is_shown(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    events: list[Any] = []
    small = {"options": gs2d.Training(overrides=("init_points=60",)), "backend": "cpu", "on_event": events.append}
    short = gs2d.train(capture, "2dgs-r", iterations=41, progress=True, **small)
    assert [stage.iterations for stage in short.recipe.stages] == [20, 7, 14]
    out, err = capsys.readouterr()
    assert out == ""
    for stage in short.recipe.stages:
        assert re.search(
            rf"^{stage.name}, loss 0\.\d+, [\d,]+ splats .* {stage.iterations}/{stage.iterations}", err, re.M
        )
    assert "preparing" not in err
    assert {"StageStarted", "Progress"} <= {type(event).__name__ for event in events}
    with pytest.raises(RecipeError, match="schedule_scale"):
        gs2d.train(capture, "2dgs-r", iterations=41, schedule_scale=0.5, **small)
