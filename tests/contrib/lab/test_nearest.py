"""Nearest neighbours: limits of distance, and coordinates that are not finite."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.contrib.lab.nearest import Cloud
from gs2d.errors import DataError

POINTS = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]], np.float32)


def test_neighbours_are_sorted_and_missing_ones_are_infinite() -> None:
    distances, index = Cloud(POINTS).nearest(np.array([[0.9, 0, 0]]), neighbours=4)
    np.testing.assert_allclose(distances, [[0.1, 0.9, 2.1, np.inf]], atol=1e-12)
    assert index.tolist() == [[1, 0, 2, 3]]
    distances, index = Cloud(POINTS).nearest(np.array([[0.9, 0, 0], [9, 0, 0]]), limit=0.5)
    assert index.tolist() == [[1], [3]]
    assert distances[:, 0].tolist() == [pytest.approx(0.1), np.inf]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_coordinates_are_an_error(bad: float) -> None:
    broken = np.array([[0.0, bad, 0]])
    with pytest.raises(DataError, match="finite"):
        Cloud(broken)
    with pytest.raises(DataError, match="queries"):
        Cloud(POINTS).nearest(broken)
