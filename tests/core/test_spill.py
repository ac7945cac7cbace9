"""A sequence that is partly on disk."""

from __future__ import annotations

import tempfile

import numpy as np
import pytest

from gs2d.core.spill import RECENT, Spilled
from gs2d.errors import DiskError


def values(count: int) -> list[tuple[int, np.ndarray]]:
    return [(k, np.random.default_rng(k).random(100)) for k in range(count)]


@pytest.mark.parametrize("limit", [0, 3000, 1 << 20])
def test_values_come_back_bit_for_bit_in_any_order(limit: int) -> None:
    given = values(2 * RECENT)
    kept = Spilled(iter(given), limit)
    assert len(kept) == len(given)
    assert kept.in_memory == {0: 0, 3000: 3, 1 << 20: len(given)}[limit]  # about 920 bytes each
    for index in [*range(len(given)), *range(len(given) - 1, -1, -3), -1]:
        assert kept[index][0] == given[index][0]
        np.testing.assert_array_equal(kept[index][1], given[index][1])
    assert [number for number, _ in kept] == list(kept.column(0)) == list(range(len(given)))
    assert [number for number, _ in kept[3:9:2]] == kept.column(0)[3:9:2] == [3, 5, 7]
    with pytest.raises(IndexError):
        kept[len(given)]


def test_a_full_disk_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    with pytest.raises(DiskError, match="cannot write a temporary file"):
        Spilled(values(2), 0)
