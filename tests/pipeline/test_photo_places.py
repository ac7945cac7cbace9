"""Places of photographs in metres: what is taken, what is left and what is said. No COLMAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gs2d.data.exif import Taken
from gs2d.errors import DataError
from gs2d.pipeline.prepare.options import PosesOptions
from gs2d.pipeline.prepare.photo_places import places_of
from gs2d.pipeline.prepare.pose_finding import _matching
from gs2d.sfm.photos import Photo

DEGREE = 111_195.0  # m of latitude, about


def photo(name: str, place: tuple[float, float, float] | None = None) -> Photo:
    return Photo(Path(name), name, name, (8, 8), Taken(place=place))


def line(count: int, step: float, *, without: int = 0) -> list[Photo]:
    """Photographs northwards, ``step`` metres apart; the first ones have no place."""
    places = [(47.0 + i * step / DEGREE, 8.0, 500.0) for i in range(count)]
    return [photo(f"{i:03}.jpg", None if i < without else place) for i, place in enumerate(places)]


def test_places_are_metres_of_a_local_frame() -> None:
    places = places_of(line(5, 20.0), None)
    assert places.notes == ()
    at = np.array(places.metres)
    np.testing.assert_allclose(np.diff(at[:, 1]), 20.0, atol=0.05)
    np.testing.assert_allclose(at[:, 0], 0.0, atol=0.01)


def test_photographs_without_a_place_are_said_and_kept() -> None:
    places = places_of(line(30, 20.0, without=5), None)
    assert (places.known, len(places.metres)) == (25, 30)
    assert places.metres[4] is None
    assert places.notes == (
        "5 of 30 photographs have no position (000.jpg, 001.jpg, 002.jpg ...; GPS in EXIF or XMP): they are compared "
        "with those next to them and those that look alike",
    )


def test_a_list_of_places_is_taken_instead_of_what_the_files_say(tmp_path: Path) -> None:
    (tmp_path / "places.csv").write_text("name,x,y,z\nsub/000.jpg,1,2,3\nsub/001.jpg,4,5,6\n")
    photos = [photo("sub/000.jpg", (47.0, 8.0, 0.0)), photo("sub/001.jpg"), photo("sub/002.jpg")]
    places = places_of(photos, tmp_path / "places.csv")
    assert places.metres[0] == (1, 2, 3)
    assert "have no position" in places.notes[0]
    (tmp_path / "others.csv").write_text("name,x,y,z\nother.jpg,1,2,3\n")
    with pytest.raises(DataError, match="photographs"):
        places_of(photos, tmp_path / "others.csv")


def test_which_pairs_are_compared_depends_on_how_many_know_their_place() -> None:
    def options(matching: str) -> PosesOptions:
        return PosesOptions(photos=Path("a"), out=Path("b"), matching=matching)  # type: ignore[arg-type]

    most, few = places_of(line(200, 20.0, without=90), None), places_of(line(200, 20.0, without=150), None)
    assert _matching(options("auto"), 150, most) == "exhaustive"
    assert _matching(options("auto"), 200, most) == "spatial"
    assert _matching(options("auto"), 200, few) == "similar"
    assert _matching(options("sequential"), 200, most) == "sequential"
    with pytest.raises(DataError, match="--matching"):
        _matching(options("spatial"), 3, places_of([photo("a.jpg")] * 3, None))
