"""Exposures in a whole run: files, scores, resuming and errors."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.perturbations import random_gains, with_gains

from ball_runs import SMALL, options
from gs2d.data.image_files import read_image, write_image
from gs2d.errors import RunError
from gs2d.io.run_dir import LEARNED, RunFolder
from gs2d.pipeline.finish.evaluate import evaluate_run
from gs2d.pipeline.finish.scoring import score_views
from gs2d.pipeline.prepare.loaded import open_finished
from gs2d.pipeline.prepare.options import EvaluateOptions, TrainOptions
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice, ignore
from gs2d.training.learned.image_exposure import exposure_gain

EARLY = (*SMALL, "learned.exposure.start=5", "learned.exposure.rate=0.2")  # so that 60 iterations show something


@pytest.fixture(scope="module")
def varied(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("varied") / "ball"
    shutil.copytree(capture, folder)
    for i, gains in enumerate(random_gains(6, 0)):
        write_image(folder / f"train/r_{i}.png", with_gains(read_image(folder / f"train/r_{i}.png"), gains))
    return folder


def learning(varied: Path, out: Path, **changes: object) -> TrainOptions:
    return options(varied, out, learn="exposure", overrides=EARLY, **changes)


@pytest.fixture(scope="module")
def run(varied: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    notices: list[str] = []

    def listen(event: Event) -> None:
        notices.extend([event.text] if isinstance(event, Notice) else [])

    made = train(learning(varied, tmp_path_factory.mktemp("runs") / "exposure"), listen)
    said = r"exposure: \S+ is the darkest photograph .* the brightest \(1\.\d+ times\): learned.json"
    assert any(re.fullmatch(said, text) for text in notices)
    return made


def test_the_transforms_are_written_and_their_mean_is_the_identity(run: RunFolder) -> None:
    views = json.loads(run.file(LEARNED).read_text())["views"]
    assert list(views) == [f"train/r_{i}.png" for i in range(6)]
    transforms = np.array([found["exposure"] for found in views.values()])
    assert transforms.mean(axis=0) == pytest.approx(np.eye(3, 4), abs=1e-6)
    assert np.abs(transforms - np.eye(3, 4)).max() > 0.02
    assert run.definition()["recipe"]["name"] == "2dgs-r-exposure"


def test_training_views_are_scored_in_their_exposures(run: RunFolder) -> None:
    _, job = open_finished(run.path, 1, ignore)
    last = run.metrics()["stages"][-1]
    for split, views in (("train", job.scene.train), ("test", job.scene.test)):
        plain, own = (
            np.mean([m.psnr.value for m in score_views(job, seen, ignore).values()])
            for seen in ([replace(view, appearance={}) for view in views], views)
        )
        assert last[split]["psnr"] == pytest.approx(own)
        assert (plain == own) == (split == "test")


def test_matched_scores_are_added_on_request(run: RunFolder) -> None:
    plain = run.metrics()["stages"][-1]
    assert "test_matched" not in plain
    matched = evaluate_run(run.path, EvaluateOptions(match="exposure"))
    assert matched["test"]["psnr"] == plain["test"]["psnr"]
    assert matched["test_matched"]["psnr"] != plain["test"]["psnr"]
    assert run.metrics()["stages"][-1]["test_matched"] == matched["test_matched"]
    assert "new views, colours matched to the photograph" in run.file("report.html").read_text()


def test_a_missing_or_damaged_file_of_exposures_is_an_error_with_a_remedy(run: RunFolder, tmp_path: Path) -> None:
    copy = RunFolder(tmp_path / "copy")
    shutil.copytree(run.path, copy.path)
    whole = copy.file(LEARNED).read_text()
    for damage in ('{"views": {"a": [1]}}', '{"views": {"a": {"exposure": [[1]]}}}', "{", whole.replace("r_0", "r_99")):
        copy.file(LEARNED).write_text(damage)
        with pytest.raises(RunError, match=r"learned\.json .*--resume"):
            evaluate_run(copy.path)
    copy.file(LEARNED).unlink()
    with pytest.raises(RunError, match="--resume"):
        evaluate_run(copy.path)


def test_the_report_shows_the_exposures(run: RunFolder) -> None:
    page = " ".join(run.file("report.html").read_text().split())
    views = json.loads(run.file(LEARNED).read_text())["views"]
    darkest = min(views, key=lambda name: exposure_gain(np.array(views[name]["exposure"])))
    assert f"{darkest} is the darkest" in page
