"""What the table of real photographs says of a finished run."""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks.street_gallery import gallery_row
from benchmarks.street_runs import measure_mesh, score_run

from ball_runs import options
from gs2d.pipeline.events import ignore
from gs2d.pipeline.prepare.loaded import open_finished
from gs2d.pipeline.train.train_run import train
from tiny import write_capture


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street")
    return train(options(write_capture(folder / "ball"), folder / "run")).path


def test_a_run_is_scored_view_by_view_as_the_run_itself_was(run: Path) -> None:
    scores = score_run(run)
    job = open_finished(run, None, ignore)
    last = job[0].metrics()["stages"][-1]
    assert scores["test"]["psnr"] == pytest.approx(last["test"]["psnr"], abs=0.01)
    assert scores["test"]["ssim"] == pytest.approx(last["test"]["ssim"], abs=1e-3)
    assert (scores["test"]["views"], scores["train"]["views"]) == (2, 6)
    assert scores["test"]["worst_psnr"] == min(scores["test"]["psnr_by_view"].values())
    assert scores["hidden"] is None  # a capture that does not say which points its photographs show
    facts = measure_mesh(run)
    assert facts["faces"] > 0
    assert facts["share_in_subject"] is None or 0.0 <= facts["share_in_subject"] <= 1.0
    assert gallery_row(run).height == 240
