"""The table of memory over the number of photographs."""

from __future__ import annotations

from benchmarks.scale import Measured, table


def test_the_table_has_a_row_for_each_number_of_photographs() -> None:
    found = [Measured(100, "train", 612.4, 9.6), Measured(100, "mesh", 500, 3), Measured(1600, "train", 620, 99)]
    assert table(found) == (
        "| photographs | `train` | `mesh` |\n|---|---|---|\n| 100 | 612 MiB, 10 s | 500 MiB, 3 s |\n"
        "| 1,600 | 620 MiB, 99 s |  |"
    )
