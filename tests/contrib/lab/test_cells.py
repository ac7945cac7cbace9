"""Cells: every place has one owner, shares are even, axes follow the capture."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.contrib.lab.cells import Cells, cut, spread_of
from gs2d.errors import RunError

RNG = np.random.default_rng(0)
PLACES = RNG.normal(size=(4000, 3)) * [10.0, 5.0, 1.0] + [100.0, -7.0, 3.0]
ONES = np.ones(len(PLACES))


def test_axes_are_those_of_the_largest_spread_whichever_way_the_capture_is_turned() -> None:
    turn = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    found = spread_of(PLACES @ turn.T, None)
    assert np.allclose(np.abs(found.axes @ turn), np.eye(3), atol=0.05)
    assert found.sides == pytest.approx([10, 5, 1], rel=0.05)
    largest = found.axes[np.arange(3), np.abs(found.axes).argmax(axis=1)]
    assert (largest > 0).all()


@pytest.mark.parametrize("grid", [(3, 2), (1, 4), (2, 2, 2)])
def test_each_place_has_one_owner_and_cells_share_the_weight_evenly(grid: tuple[int, ...]) -> None:
    cells = cut(PLACES, ONES, np.eye(3)[: len(grid)], grid, 0.2)
    owners = cells.owners(PLACES)
    assert len(cells) == np.prod(grid)
    assert np.bincount(owners, minlength=len(cells)) == pytest.approx(len(PLACES) / len(cells), abs=12)
    anywhere = RNG.normal(size=(500, 3)) * 1e4
    held = sum(((anywhere[:, : len(grid)] >= low) & (anywhere[:, : len(grid)] < high)).all(axis=1).astype(int)
               for low, high in zip(cells.low, cells.high, strict=True))  # fmt: skip
    assert (held == 1).all()


def test_cells_come_back_from_json() -> None:
    cells = cut(PLACES, ONES, np.eye(3)[:2], (2, 3), 0.2)
    again = Cells.from_json(cells.to_json())
    assert again.names == ("0-0", "0-1", "0-2", "1-0", "1-1", "1-2")
    for name in ("axes", "low", "high"):
        assert np.array_equal(getattr(again, name), getattr(cells, name))
    assert again.margin == cells.margin
    with pytest.raises(RunError, match="the cells of a partition are damaged"):
        Cells.from_json({"axes": [[1, 0, 0]], "cells": [{"low": 3}]})
