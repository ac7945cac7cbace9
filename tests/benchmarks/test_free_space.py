"""The benchmark of looks at free space, gone through on a toy capture."""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks.flight import Flight, write_flight
from benchmarks.free_space import main

from gs2d.training.robust import free_space_maps as free_space


@pytest.mark.usefixtures("native")
def test_it_tells_of_each_capture_what_a_look_takes_both_ways(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_flight(tmp_path / "flown", Flight(12, width=64, height=48, points=3000, seed=1))
    before = free_space.look_at_free_space
    assert main([f"{tmp_path / 'flown'}:1", "--repeat", "1"]) == 0
    cells = capsys.readouterr().out.splitlines()[-1].strip("| ").split(" | ")
    assert cells[:2] == ["flown", "10"]  # two are for testing
    assert int(cells[2].replace(",", "")) > 500
    assert float(cells[3]) < float(cells[4])
    assert int(cells[6]) <= 5
    assert free_space.look_at_free_space is before
