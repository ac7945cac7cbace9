"""The curves of quality against seconds: what is trained and counted, that it goes on, and what is drawn."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benchmarks import quality_run, time_to_quality
from benchmarks.street_runs import Process
from PIL import Image

from gs2d.contrib.demo.demo_capture import write_demo_capture


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
