"""Gates without noise: instruction counts of the kernels against the committed ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from benchmarks import instructions

LISTING = """
   10:\tvmulps %zmm0,%zmm1,%zmm2
   16:\tvaddps %zmm0,%zmm1,%zmm2
   1c:\tvmovaps %ymm0,%ymm1
   20:\tjne    16 <f+0x6>
   22:\tvmulps %zmm0,%zmm1,%zmm2
   28:\tjmp    10 <f>
"""


@pytest.fixture
def committed() -> dict[str, Any]:
    """The committed counts, if they are of this compiler."""
    document: dict[str, Any] = json.loads(instructions.COMMITTED.read_text())
    try:
        version = instructions.compiler_version()
    except instructions.Unavailable as reason:
        pytest.skip(str(reason))
    if version != document["compiler"]:
        pytest.skip(f"the committed counts are of {document['compiler']}, this is {version}")
    return document


def test_only_innermost_vector_loops_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instructions, "MIN_VECTOR", 1)
    assert instructions.vector_loops(LISTING) == [(3, 1)]  # 16, 1c, 20; the loop from 10 to 28 holds it
    monkeypatch.setattr(instructions, "MIN_VECTOR", 2)
    assert instructions.vector_loops(LISTING) == []


def test_a_count_may_leave_its_tolerance_in_neither_direction() -> None:
    for value, lines in ((1020, 0), (980, 0), (1021, 1), (979, 1)):
        assert len(instructions.excess({"forward": value}, {"forward": 1000}, 0.02)) == lines
    assert "committed file has backward" in instructions.excess({"forward": 1}, {"backward": 1}, 0.02)[0]


@pytest.mark.parametrize(
    ("count", "name", "tolerance"),
    [
        (instructions.callgrind_counts, "callgrind_avx2", instructions.CALLGRIND_TOLERANCE),  # of the whole library
        (instructions.loop_counts, "loops_avx512", instructions.LOOP_TOLERANCE),  # of the blend loops
    ],
)
def test_as_many_instructions_as_committed(
    committed: dict[str, Any], count: Callable[[], dict[str, int]], name: str, tolerance: float
) -> None:
    try:
        counts = count()
    except instructions.Unavailable as reason:
        pytest.skip(str(reason))
    over = instructions.excess(counts, committed[name], tolerance)
    assert not over, f"{over}; if it is meant: python -m benchmarks.instructions --update"
