"""What is said of a path that leads nowhere."""

from pathlib import Path

import pytest

from gs2d.core.missing import where_it_ends


def test_a_path_that_is_nearly_right_is_answered_with_the_right_one(tmp_path: Path) -> None:
    (tmp_path / "my photos" / "chair").mkdir(parents=True)
    assert where_it_ends(tmp_path / "myphotos") == f"; did you mean {tmp_path / 'my photos'}?"
    assert where_it_ends(tmp_path / "My Photos" / "chair") == f"; did you mean {tmp_path / 'my photos' / 'chair'}?"
    assert where_it_ends(tmp_path / "my_photos" / "table") == f"; did you mean {tmp_path / 'my photos'}?"


def test_a_path_that_is_like_nothing_is_answered_with_the_folder_it_was_looked_for_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert where_it_ends(Path("photos")) == f"; there is no photos in {tmp_path.resolve()}"
    assert where_it_ends(Path("a/b/c")) == f"; there is no a in {tmp_path.resolve()}"


def test_a_file_in_the_place_of_a_folder_is_a_path_to_be_checked(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert where_it_ends(tmp_path / "file" / "photos") == "; check the path"
