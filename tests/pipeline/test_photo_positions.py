"""Positions of photographs in metres, and the choice of pairs by them. No COLMAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gs2d.data.exif import Metadata
from gs2d.errors import DataError
from gs2d.pipeline.prepare.pose_finding import _matching, metric_positions
from gs2d.sfm.photos import Photo

DEGREE = 111_195.0  # m of latitude, approximately


def photo(name: str, place: tuple[float, float, float] | None = None) -> Photo:
    return Photo(Path(name), name, name, (8, 8), Metadata(place=place))


def line(count: int, step: float, *, without: int = 0) -> list[Photo]:
    """Photographs northwards, ``step`` metres apart; the first ones have no position."""
    places = [(47.0 + i * step / DEGREE, 8.0, 500.0) for i in range(count)]
    return [photo(f"{i:03}.jpg", None if i < without else place) for i, place in enumerate(places)]


def test_positions_are_metres_in_a_local_frame() -> None:
    positions, note = metric_positions(line(5, 20.0), None)
    assert note == ""
    at = np.array(positions)
    np.testing.assert_allclose(np.diff(at[:, 1]), 20.0, atol=0.05)
    np.testing.assert_allclose(at[:, 0], 0.0, atol=0.01)


def test_photographs_without_a_position_are_reported() -> None:
    positions, note = metric_positions(line(30, 20.0, without=5), None)
    assert positions[:5] == [None] * 5
    assert None not in positions[5:]
    assert note == "5 of 30 photographs have no position (000.jpg, 001.jpg, 002.jpg ...; GPS in EXIF)"


def test_positions_within_the_error_of_gps_are_not_used() -> None:
    positions, note = metric_positions(line(5, 1.0), None)
    assert positions == [None] * 5
    assert "not used" in note


def test_a_list_of_positions_replaces_those_in_the_files(tmp_path: Path) -> None:
    (tmp_path / "places.csv").write_text("name,x,y,z\nsub/000.jpg,1,2,3\nsub/001.jpg,4,5,6\n")
    photos = [photo("sub/000.jpg", (47.0, 8.0, 0.0)), photo("sub/001.jpg"), photo("sub/002.jpg")]
    positions, note = metric_positions(photos, tmp_path / "places.csv")
    assert positions[0] == (1, 2, 3)
    assert "have no position" in note
    (tmp_path / "others.csv").write_text("name,x,y,z\nother.jpg,1,2,3\n")
    with pytest.raises(DataError, match="photographs"):
        metric_positions(photos, tmp_path / "others.csv")


def test_pairs_are_chosen_by_the_number_of_photographs_with_positions() -> None:
    assert _matching("auto", 150, 110) == "exhaustive"
    assert _matching("auto", 200, 110) == "spatial"
    assert _matching("auto", 200, 50) == "similar"
    assert _matching("sequential", 200, 110) == "sequential"
    with pytest.raises(DataError, match="--matching"):
        _matching("spatial", 3, 0)
