"""A tiny capture and a run of it, for all tests of the command line; they are never changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from cli_runs import TINY
from gs2d.cli import run
from tiny import write_capture


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("data") / "ball", train=3, test=1, size=20)


@pytest.fixture(scope="session")
def trained(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    assert run(["train", str(capture), "--out", str(out), "--quiet", "--threads", "1", *TINY]) == 0
    return out
