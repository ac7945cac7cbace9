"""Tables of names and numbers: errors name file and line."""

from __future__ import annotations

from pathlib import Path

import pytest

from gs2d.data.positions import read_table
from gs2d.errors import DataError

COLUMNS = ("name", "x", "y", "z")


def table(folder: Path, text: str) -> Path:
    path = folder / "places.csv"
    path.write_text(text)
    return path


def test_an_unclosed_quote_ends_with_its_line(tmp_path: Path) -> None:
    """It swallowed the lines below it, and their number was a ValueError."""
    read = read_table(table(tmp_path, 'name,x,y,z\n"a, 1,2,3\n"b, c",4,5,6\n'), COLUMNS, ("name",))
    assert [(line, row["name"]) for line, row in read.rows] == [(2, "a, 1,2,3"), (3, "b, c")]
    with pytest.raises(DataError, match="line 2: a number was expected for x, got ''"):
        read.number(*read.rows[0], "x")


def test_a_field_beyond_the_limit_of_csv_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="line 2: values separated by ',' were expected: field larger"):
        read_table(table(tmp_path, "name,x\n" + "a" * 200_000 + ",1\n"), COLUMNS, ("name",))


def test_a_row_with_more_values_than_the_header_has_columns_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="line 3: 2 values were expected, got 3"):
        read_table(table(tmp_path, "name,x\na,1\nb,2,3\n"), COLUMNS, ("name",))
