"""The benchmark of what comparing two views costs."""

from __future__ import annotations

import pytest
from benchmarks.multiview import run


def test_each_part_is_timed_beside_an_iteration_without_it(native: None) -> None:
    row = run(300, 64, 1, 2)
    times, fractions = row["cpu_ms"], row["of_an_iteration_without"]
    assert isinstance(times, dict)
    assert isinstance(fractions, dict)
    assert all(value > 0 for value in times.values())
    assert fractions["iteration without"] == 1
    part = "losses, native"
    assert fractions[part] == pytest.approx(times[part] / times["iteration without"], rel=1e-2)
