"""Partitions as data: what `--blocks` and `--set partition.NAME=VALUE` say, and what is refused."""

from __future__ import annotations

import pytest

from gs2d.contrib.lab.partition import (
    CoarseModel,
    Partition,
    from_json,
    grid_for,
    make_partition,
    parse_grid,
    to_json,
)
from gs2d.errors import RecipeError


def test_a_grid_is_two_or_three_numbers() -> None:
    assert parse_grid("3x2") == (3, 2)
    assert parse_grid("2x2x4") == (2, 2, 4)
    assert parse_grid("auto") == ()


@pytest.mark.parametrize("text", ["0x3", "3", "3x", "x", "axb", "2x2x2x2", "-1x2", "", "3 x 3", "999999x1"])
def test_what_is_no_grid_is_refused(text: str) -> None:
    with pytest.raises(RecipeError, match="--blocks must be auto, or two or three whole numbers of 1 or more"):
        parse_grid(text)


def test_fields_are_changed_by_name_and_come_back_from_json() -> None:
    made = make_partition("4x1", ("margin=0.5", "coarse.side=800", "extent=block"))
    assert made == Partition(grid=(4, 1), margin=0.5, coarse=CoarseModel(side=800), extent="block")
    assert from_json(to_json(made)) == made


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("margins=1", "--set partition.FIELD=VALUE takes the fields margin, min_share"),
        ("margin", "--set partition.FIELD=VALUE takes the fields margin, min_share"),
        ("coarse=3", "--set partition.FIELD=VALUE takes the fields margin, min_share"),
        ("grid.x=3", "--set partition.FIELD=VALUE takes the fields margin, min_share"),
        ("margin=wide", "partition.margin must be a number, got 'wide'"),
        ("margin=-1", "partition.margin must be a finite number >= 0, got -1"),
        ("margin=1.5", "partition.margin must be at most 1 side of a cell, got 1.5"),
        ("min_share=1", "partition.min_share must be below 1, got 1"),
        ("min_views=0", "partition.min_views must be an integer >= 1, got 0"),
        ("extent=all", "partition.extent must be one of scene, block; got 'all'"),
        ("coarse.schedule=0", r"partition.coarse.schedule must be in \(0, 1\], got 0"),
        ("coarse.side=8", "partition.coarse.side must be an integer >= 16, got 8"),
    ],
)
def test_what_cannot_be_cut_by_is_one_line(change: str, text: str) -> None:
    with pytest.raises(RecipeError, match=text) as error:
        make_partition("2x2", (change,))
    assert "\n" not in str(error.value)


def test_open_grids_have_cells_about_as_long_as_wide_and_a_third_axis_where_it_is_high() -> None:
    assert grid_for(8, [4.0, 2.0, 0.1], flat=0.5) == (4, 2)  # cells of 1 x 1
    assert grid_for(5, [1.0, 1.0, 0.1], flat=0.5) == (3, 2)
    assert grid_for(8, [1.0, 1.0, 0.9], flat=0.5) == (2, 2, 2)
    assert grid_for(4, [100.0, 1.0, 0.1], flat=0.5) == (4, 1)
