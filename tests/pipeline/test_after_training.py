"""After training, the splats are written first, and no later step can end the run."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import pytest

from ball_runs import SCALE, SMALL, failing, options
from gs2d.cli import run as gs2d
from gs2d.errors import DataError
from gs2d.io.run_dir import RunFolder
from gs2d.io.splat_ply import read_splats
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, NotMade

LATER = {  # steps after training, with the result that is missing if they fail
    "train.run_logger.write_poses": "refined cameras and exposures",
    "train.run_logger.write_appearance": "refined cameras and exposures",
    "train.run_logger.score_views": "scores of train views, stage refine",
    "train.run_logger.split_metrics": "scores of train views, stage refine",
    "train.run_logger.draw_stage": "images of stage refine",
    "train.run_logger.StageScored": "scores of stage refine",
    "finish.run_mesh.fusion_frame": "mesh.ply",
    "finish.run_verdict.Collector._measure": "verdict.json",
    "train.train_run.meshed_subject": "mesh.ply",
    "train.train_run.extract_mesh": "mesh.ply",
    "train.train_run.write_mesh_metrics": "mesh.ply",
    "train.train_run.page_run": "scene.html",
    "train.train_run.write_verdict": "verdict.json",
    "finish.run_report.report_run": "report.html",
}
ERRORS = (DataError("the points are gone"), ZeroDivisionError("a fault"))


@pytest.fixture
def trained(undisturbed: RunFolder, tmp_path: Path) -> Path:
    """A run killed after its last iteration: its last stage has checkpoints only."""
    copy = RunFolder(Path(shutil.copytree(undisturbed.path, tmp_path / "run")))
    for name in ("splats.ply", "mesh.ply", "scene.html", "verdict.json", "report.html", "subject.json"):
        copy.file(name).unlink()
    copy.write_metrics({"stages": copy.metrics()["stages"][:-1], "surface": None})
    return copy.path


@pytest.mark.parametrize(("place", "error"), list(zip(LATER, itertools.cycle(ERRORS), strict=False)))
def test_a_step_that_fails_after_training_is_reported_and_the_splats_remain(
    place: str,
    error: Exception,
    capture: Path,
    undisturbed: RunFolder,
    trained: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(f"gs2d.pipeline.{place}", failing(error))
    words = ["train", str(capture), "--out", str(trained), "--schedule-scale", str(SCALE), "--recipe", "2dgs-r"]
    words += [word for override in SMALL for word in ("--set", override)]
    code = gs2d([*words, "--threads", "1", "--checkpoint-every", "4", "--resume"])
    told = " ".join(capsys.readouterr().err.split())
    assert code == 3
    assert f"not made {LATER[place]}: " in told
    assert str(error) in told
    assert (trained / "splats.ply").read_bytes() == undisturbed.file("splats.ply").read_bytes()


def test_the_splats_are_written_even_if_views_cannot_be_scored(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gs2d.pipeline.train.run_logger.score_views", failing(DataError("no points")))
    heard: list[Event] = []
    run = train(options(capture, tmp_path / "run", page=False), heard.append)
    assert len(read_splats(run.file("splats.ply"))) > 0
    missing = [event.what for event in heard if isinstance(event, NotMade)]
    assert [what for what in missing if what.endswith("refine")] == [
        "scores of train views, stage refine",
        "scores of test views, stage refine",
    ]
    assert run.metrics()["stages"][-1]["train"] is None
    assert {"mesh.ply", "report.html"} <= {path.name for path in run.path.iterdir()}
    monkeypatch.undo()
    run = train(options(capture, run.path, page=False, resume=True))
    assert run.metrics()["stages"][-1]["train"]["psnr"] > 0
    assert "train_reason" not in run.metrics()["stages"][-1]
    assert run.file("verdict.json").exists()
