"""Reading COLMAP's database after its process has ended."""

from __future__ import annotations

from pathlib import Path

import pytest

from gs2d.errors import DataError
from gs2d.sfm.colmap_process import read_match_counts


@pytest.mark.parametrize("data", [None, b"no database", b""])
def test_an_unreadable_database_is_a_one_line_error(tmp_path: Path, data: bytes | None) -> None:
    """On a full disk, SQLite cannot recover from its journal."""
    if data is not None:
        (tmp_path / "database.db").write_bytes(data)
    with pytest.raises(DataError, match=r"database\.db"):
        read_match_counts(tmp_path / "database.db")
