"""``gs2d evaluate`` with the ground truth in the capture."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import pytest

from gs2d.contrib.lab.surface_score import evaluate_surface
from gs2d.io.run_dir import RunFolder, open_run
from gs2d.pipeline.finish.evaluate import evaluate_run
from gs2d.pipeline.finish.run_mesh import mesh_run
from gs2d.pipeline.prepare.options import EvaluateOptions, MeshOptions
from gs2d.training.events import Event, Notice
from tiny import write_ball_mesh


@pytest.fixture
def beside(undisturbed: RunFolder, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """A copy of the run whose capture has a true mesh; and that capture."""
    monkeypatch.setattr("gs2d.contrib.lab.visible_surface.evaluate_surface", partial(evaluate_surface, samples=2000))
    run, folder = tmp_path / "run", tmp_path / "ball"
    shutil.copytree(undisturbed.path, run)
    shutil.copytree(capture, folder)
    write_ball_mesh(folder / "mesh_gt.ply")
    write_ball_mesh(run / "mesh.ply")
    definition = json.loads((run / "run.json").read_text())
    definition["scene"]["path"] = str(folder)
    (run / "run.json").write_text(json.dumps(definition))
    return run, folder


def test_a_true_mesh_in_the_capture_is_used_and_meshing_again_removes_its_score(beside: tuple[Path, Path]) -> None:
    run, folder = beside
    heard: list[Event] = []
    surface = evaluate_run(run, EvaluateOptions(), heard.append)["surface"]
    assert f"ground truth: {folder / 'mesh_gt.ply'}" in [e.text for e in heard if isinstance(e, Notice)]
    assert surface["evaluator"] == "visible-surface"
    assert surface["f_score"] == surface["thresholds"][0]["f_score"] > 0.99  # the same surface
    assert surface["self_check"] == {"ok": True, "messages": []}
    assert open_run(run).metrics()["surface"] == json.loads(json.dumps(surface))
    for name in surface["files"].values():
        assert (run / name).is_file()
    mesh_run(run, MeshOptions(voxel=0.2, truncation=0.6))
    assert open_run(run).metrics()["surface"] is None
    assert not (run / "surface").exists()
