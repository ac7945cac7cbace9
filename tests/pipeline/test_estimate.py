"""Estimates of time and memory before training, and errors for trainings that do not fit."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks.flight import Flight, write_flight

from gs2d.config.presets import get_recipe
from gs2d.core import memory_limit
from gs2d.data import Scene, load_scene
from gs2d.errors import DataError
from gs2d.pipeline.prepare import estimate as module
from gs2d.pipeline.prepare.estimate import PROGRAM_BYTES, Estimate, estimate
from gs2d.render.backends import get_backend
from train_toys import backends


@pytest.fixture(autouse=True)
def no_budget() -> object:
    yield
    memory_limit.set_memory_budget(None)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown") / "capture"
    write_flight(folder, Flight(12, width=64, height=48, points=6000, seed=1))
    return folder


@pytest.fixture(scope="module")
def scene(capture: Path) -> Scene:
    return load_scene(capture)


def estimated(scene: Scene) -> Estimate:
    return estimate(scene, get_recipe("2dgs"), get_backend(backends()[-1]))


def test_an_estimate_has_bounds(scene: Scene) -> None:
    found = estimated(scene)
    assert found.max_splats is None
    assert scene.points is not None
    assert found.start == len(scene.points)
    assert 0 < found.seconds.least < found.seconds.expected < found.seconds.most
    assert PROGRAM_BYTES < found.memory.least <= found.memory.expected <= found.memory.most
    assert found.line().startswith("the run will take about ")


def test_memory_limits_the_splats(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SPLAT_BYTES", 1 << 20)  # a thousand are a gigabyte
    memory_limit.set_memory_budget(2 << 30)
    monkeypatch.setattr(module, "initial_splats", lambda *_: 600)
    found = estimated(scene)
    assert found.max_splats is not None
    assert found.start < found.max_splats < 1700
    assert found.memory.most <= 2 << 30
    assert f"more than {found.max_splats:,} splats do not fit" in found.line()
    monkeypatch.setattr(module, "SPLAT_BYTES", 1 << 24)
    with pytest.raises(DataError, match="photographs"):
        estimated(scene)


def test_too_little_memory_is_an_error_and_leaves_nothing(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["train", capture, "--out", out, "--recipe", "2dgs", "--schedule-scale", "0.001", "--memory", "0.5"]
    # In a process of its own: what other tests hold would count.
    ran = subprocess.run([sys.executable, "-m", "gs2d", *words, "--quiet"], capture_output=True, text=True, check=False)
    assert ran.returncode == 2
    assert "photographs" in ran.stderr
    assert ran.stderr.count("\n") == 1
    assert not out.exists()
