"""A tiny capture and a run of it, shared by all tests of the pipeline and never changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from ball_runs import options
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.train.train_run import train
from tiny import write_capture


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("data") / "ball")


@pytest.fixture(scope="session")
def undisturbed(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return train(options(capture, tmp_path_factory.mktemp("runs") / "undisturbed"))
