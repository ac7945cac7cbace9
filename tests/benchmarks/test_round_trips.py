"""What benchmarks/round_trips.py says of formats: the same where nothing is lost, less where colours are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks import round_trips

from ball_runs import options
from gs2d.pipeline.train import train
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


def test_the_levels_of_a_stream_are_a_table_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train(options(write_capture(tmp_path / "ball", size=32), tmp_path / "run"))
    assert round_trips.main([str(tmp_path / "run"), "--layouts", "streamed", "--split", "train", "--every", "3"]) == 0
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()[-4:]]
    assert [line[0] for line in lines] == ["0", "1", "2", "3"]
    counts, fulls, eighths = ([float(line[k].replace(",", "")) for line in lines] for k in (1, 3, 6))
    assert counts == sorted(counts, reverse=True)
    assert counts[3] <= counts[0] / 7
    assert fulls == sorted(fulls, reverse=True)
    assert all(a >= b for a, b in zip(eighths, fulls, strict=True))  # of fewer pixels more is alike


def test_the_mean_is_of_decibels() -> None:
    black = [np.zeros((2, 2, 3))] * 2
    assert round_trips.psnr(black, [np.full((2, 2, 3), 0.1), np.full((2, 2, 3), 0.01)]) == pytest.approx(30.0)
