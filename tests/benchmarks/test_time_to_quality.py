"""The curves of quality against seconds: what is trained and counted, that it goes on, and what is drawn."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benchmarks import quality_run, time_to_quality
from benchmarks.quality_run import Clocks
from benchmarks.street_runs import Process
from PIL import Image

from gs2d.synthetic.capture import write_demo_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "still"
    write_demo_capture(folder, train_views=5, test_views=2, size=24, threads=1)
    return folder


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Trainings run here, not in a process each; the list gets the folder of each."""
    started: list[str] = []

    def watch(command: list[str], console: Path, **_: Any) -> Process:
        file = Path(command[3])
        started.append(file.parent.name)
        code = quality_run.main(command[3:])
        console.write_text("")
        return Process(command, code, 0.0, 0.0, None, 0)

    monkeypatch.setattr(time_to_quality, "watch_process", watch)
    return started


def words(capture: Path, out: Path, *more: str) -> list[str]:
    return [str(capture), "--out", str(out), "--recipes", "2dgs", "2dgs-60k", "--threads", "1", "--points", "2", *more]


# -- trainings -----------------------------------------------------------------------------------------------------
def test_the_command_trains_scores_and_draws(
    capture: Path, tmp_path: Path, in_process: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    results, figure = tmp_path / "results.json", tmp_path / "figure.png"
    more = ("--recipes", "2dgs", "--scales", "0.001", "--results", str(results), "--figure", str(figure))
    assert time_to_quality.main(words(capture, tmp_path / "out", *more)) == 0
    (entry,) = json.loads(results.read_text())["captures"]
    assert (entry["train_views"], entry["test_views"], entry["truth"]) == (5, 2, True)
    ((run,),) = (curve["runs"] for curve in entry["curves"])
    (point,) = run["course"]
    assert (point["iterations"], run["iterations"]) == (20, 30)
    assert 0 < point["user_seconds"] < run["user_seconds"]
    assert point["seconds"] < run["seconds"]
    assert 5 < run["images"]["psnr"] < 60
    assert 0 <= run["surface"]["f_scores"]["0.0025"] <= run["surface"]["f_scores"]["0.01"] <= 1
    assert "| still | 2dgs | 0.001 |" in capsys.readouterr().out
    assert np.asarray(Image.open(figure)).shape[1] > 1000


def test_a_training_that_was_cut_off_goes_on_to_the_same_splats_with_its_seconds(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    args = time_to_quality.parse(words(capture, tmp_path, "--points", "3"))
    spec = time_to_quality.specification(capture, 1, "2dgs", 0.001, 0, args)
    seen: dict[str, np.ndarray] = {}

    def surface(job: Any, state: Any, *_: Any) -> dict[str, Any]:
        seen[place.name] = state.splats.means.numpy().copy()
        return {"surface": None}

    monkeypatch.setattr(quality_run, "surface", surface)
    place = tmp_path / "whole"
    place.mkdir()
    whole = quality_run.train(spec, place, Clocks(time.time()))
    place = tmp_path / "cut"
    place.mkdir()
    score, count = quality_run.score, []

    def cut_off(*arguments: Any) -> dict[str, Any]:
        count.append(1)
        if len(count) == 2:
            raise KeyboardInterrupt
        return score(*arguments)

    monkeypatch.setattr(quality_run, "score", cut_off)
    with pytest.raises(KeyboardInterrupt):
        quality_run.train(spec, place, Clocks(time.time() - 1000.0))
    monkeypatch.setattr(quality_run, "score", score)
    went_on = quality_run.train(spec, place, Clocks(time.time()))
    assert (seen["cut"] == seen["whole"]).all()
    assert [point["iterations"] for point in went_on["course"]] == [10, 20]
    assert [point["images"] for point in went_on["course"]] == [point["images"] for point in whole["course"]]
    assert 1000.0 < went_on["course"][0]["seconds"] < went_on["course"][1]["seconds"] < went_on["seconds"] < 1100.0
