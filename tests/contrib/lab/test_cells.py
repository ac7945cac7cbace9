"""Cells: every place has one owner, shares are even, axes follow the capture."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gs2d.contrib.lab.cells import Cells, cut, spread_of
from gs2d.errors import RunError
from gs2d.pipeline.prepare.part import inside

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


def test_a_place_on_a_seam_belongs_to_the_upper_cell() -> None:
    cells = cut(PLACES, ONES, np.eye(3)[:2], (2, 1), 0.0)
    seam = cells.high[0, 0]
    places = np.array([[seam, 0, 0], [np.nextafter(seam, -np.inf), 0, 0]])
    assert cells.owners(places).tolist() == [1, 0]


def test_the_margin_is_of_a_cells_side_and_reaches_beyond_seams_alone() -> None:
    line = np.stack([np.linspace(0, 100, 10001), np.linspace(0, 40, 10001), np.zeros(10001)], axis=1)
    line[:, 1] = RNG.permutation(line[:, 1])
    cells = cut(line, np.ones(len(line)), np.eye(3)[:2], (2, 1), 0.25)
    assert cells.margin == pytest.approx(0.25 * (0.98 * 100 / 2 + 0.98 * 40) / 2, rel=0.02)
    places = np.array([[50 + 0.99 * cells.margin, 20, 0], [50 + 1.01 * cells.margin, 20, 0], [-1e9, 0, 0]])
    assert cells.near(0, places).tolist() == [True, False, True]


def test_the_distance_to_a_seam_is_that_to_another_cell() -> None:
    cells = cut(PLACES, ONES, np.eye(3)[:2], (2, 1), 0.2)
    seam = cells.high[0, 0]
    places = np.array([[seam + 3, 1e3, 0], [seam - 2, -1e3, 5]])
    assert cells.distance_to_seam(places) == pytest.approx([3, 2])


def test_the_region_of_a_cell_is_what_lies_near_it() -> None:
    cells = cut(PLACES, ONES, np.eye(3)[:2], (2, 2), 0.3)
    for cell in range(4):
        found = inside(cells.region(cell), torch.from_numpy(PLACES)).numpy()
        assert np.array_equal(found, cells.near(cell, PLACES))
        assert 0.25 * len(PLACES) < found.sum() < 0.7 * len(PLACES)


def test_cells_come_back_from_json() -> None:
    cells = cut(PLACES, ONES, np.eye(3)[:2], (2, 3), 0.2)
    again = Cells.from_json(cells.to_json())
    assert again.names == ("0-0", "0-1", "0-2", "1-0", "1-1", "1-2")
    for name in ("axes", "low", "high"):
        assert np.array_equal(getattr(again, name), getattr(cells, name))
    assert again.margin == cells.margin
    with pytest.raises(RunError, match="the cells of a partition are damaged"):
        Cells.from_json({"axes": [[1, 0, 0]], "cells": [{"low": 3}]})
