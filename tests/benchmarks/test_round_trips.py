"""What benchmarks/round_trips.py says of formats: the same where nothing is lost, less where colours are."""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks import round_trips

from ball_runs import options
from gs2d.pipeline.train.train_run import train
from tiny import write_capture


def test_a_format_that_keeps_all_is_the_same_and_one_without_harmonics_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(options(write_capture(tmp_path / "ball", size=32), tmp_path / "run"))
    words = [str(tmp_path / "run"), "--layouts", "2dgs", "splat", "--split", "train", "--every", "3"]
    assert round_trips.main(words) == 0
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()[-2:]]
    assert [line[0] for line in lines] == ["`2dgs`", "`splat`"]
    assert lines[0][2] == "the same"
    assert 10 < float(lines[1][2]) < 60
    assert float(lines[1][1]) == 32.0
