"""The table of memory over the number of photographs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks.scale import Measured, main, table


def test_the_table_has_a_row_for_each_number_of_photographs() -> None:
    found = [Measured(100, "train", 612.4, 9.6), Measured(100, "mesh", 500, 3), Measured(1600, "train", 620, 99)]
    assert table(found) == (
        "| photographs | `train` | `mesh` |\n|---|---|---|\n| 100 | 612 MiB, 10 s | 500 MiB, 3 s |\n"
        "| 1,600 | 620 MiB, 99 s |  |"
    )


@pytest.mark.slow
def test_memory_is_the_same_for_a_hundred_and_for_four_hundred_photographs(tmp_path: Path) -> None:
    numbers = ["--photographs", "100", "400", "--compare", "100", "--iterations", "60"]
    land = ["--side", "110", "--land", "96"]  # the same surface, by any number of them
    assert main([str(tmp_path), *numbers, *land, "--threads", "1"]) == 0
    rows = json.loads((tmp_path / "scale.json").read_text())
    for command in ("train", "mesh", "report"):
        few, many = (row["mib"] for row in rows if row["command"] == command)
        assert many < 1.1 * few, command
