"""`gs2d plan`: estimates before training, and errors for trainings that do not fit."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from benchmarks.flight import Flight, write_flight

from gs2d.cli.app import run as main
from gs2d.core import memory_limit
from gs2d.errors import DataError
from gs2d.pipeline.prepare import estimate as module
from gs2d.pipeline.prepare.estimate import PROGRAM_BYTES, plan
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train import train_run as train_module
from gs2d.pipeline.train.train_run import train


@pytest.fixture(autouse=True)
def no_budget() -> object:
    yield
    memory_limit.set_memory_budget(None)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown") / "capture"
    write_flight(folder, Flight(12, width=64, height=48, points=6000, seed=1))
    return folder


def planned(capture: Path, **more: object) -> TrainOptions:
    given = {"schedule_scale": 0.01, "recipe": "2dgs", **more}
    return TrainOptions(out=Path("RUN"), scene=capture, **given)  # type: ignore[arg-type]


def test_a_plan_estimates_with_bounds_and_writes_nothing(capture: Path) -> None:
    before = sorted(path.name for path in capture.rglob("*"))
    found = plan(planned(capture))
    assert (found.photographs, found.pixels) == (12, 12 * 64 * 48)
    assert (found.downscale, found.prepared, found.max_splats, found.iterations) == (1, False, None, 300)
    assert found.splats.least < found.start < found.splats.expected < found.splats.most
    assert 0 < found.seconds.least < found.seconds.expected < found.seconds.most
    assert PROGRAM_BYTES < found.memory.least <= found.memory.expected <= found.memory.most
    assert found.disk > 8 * found.pixels
    lines = found.lines()
    assert [line.partition(":")[0] for line in lines] == ["photographs", "splats", "memory", "disk", "time"]
    assert lines[0] == "photographs: 12 with 0.0369 megapixels in total, in memory"
    assert sorted(path.name for path in capture.rglob("*")) == before


def test_the_command_line_tells_it_as_json(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [str(capture), "--recipe", "2dgs", "--schedule-scale", "0.01", "--set", "prepare=always", "--dry-run"]
    assert main(["train", *words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["prepared"] is True
    assert told["disk"] > 12 * 64 * 48
    assert not Path("RUN").exists()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"downscale": 2, "test_every": 4, "learn": "exposure"},
        {"depth_prior": "sparse", "robust": "off"},
        {"format": "colmap", "masked": "ignore", "recipe": "best", "seed": 3},
        {"quality": "draft"},
    ],
)
def test_a_plan_estimates_the_training_of_the_same_options(
    options: dict[str, Any], capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Any, ...]] = []

    class Asked(Exception):
        pass

    def listen(scene: Any, recipe: Any, backend: Any, **more: Any) -> None:
        asked.append((recipe, [view.name for view in scene.train], scene.train[0].camera.width, backend.name, more))
        raise Asked

    for place in (module, train_module):
        monkeypatch.setattr(place, "estimate", listen)
    given = {"recipe": "2dgs", "schedule_scale": 0.01, **options}
    with pytest.raises(Asked):
        plan(TrainOptions(scene=capture, out=tmp_path / "run", **given))
    with pytest.raises(Asked):
        train(TrainOptions(scene=capture, out=tmp_path / "run", memory=1000.0, **given))
    assert asked[0] == asked[1]


def test_a_plan_limits_the_splats_to_the_memory(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SPLAT_BYTES", 1 << 20)  # a thousand are a gigabyte
    options = planned(capture, memory=2.0)
    found = plan(options)
    assert found.max_splats is not None
    assert found.start < found.max_splats < 1700
    assert found.memory.most <= 2 << 30
    assert f"use --set STAGE.densify.max_splats={found.max_splats}" in found.lines()[1]
    monkeypatch.setattr(module, "SPLAT_BYTES", 1 << 24)
    with pytest.raises(DataError, match="photographs"):
        plan(options)


def test_too_little_memory_or_disk_is_an_error_and_leaves_nothing(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, said in (
        (["--memory", "0.5"], r"need .* GiB.*\b0\.5 GiB"),  # which of both needs depends on what other tests hold
        (["--downscale", "0"], "--downscale must be a whole number >= 1, got 0"),
    ):
        command = [
            "train",
            str(capture),
            "--dry-run",
            "--recipe",
            "2dgs",
            "--schedule-scale",
            "0.01",
            "--quiet",
            *words,
        ]
        assert main([*command, *words]) == 2
        error = capsys.readouterr().err
        assert re.search(said, error)
        assert error.count("\n") == 1
    out = tmp_path / "run"
    words = ["train", capture, "--out", out, "--recipe", "2dgs", "--schedule-scale", "0.001", "--memory", "0.5"]
    # In a process of its own: what other tests hold would count.
    ran = subprocess.run([sys.executable, "-m", "gs2d", *words, "--quiet"], capture_output=True, text=True, check=False)
    assert ran.returncode == 2
    assert "photographs" in ran.stderr
    assert ran.stderr.count("\n") == 1
    assert not out.exists()
