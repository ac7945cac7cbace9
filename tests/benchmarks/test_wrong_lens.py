"""The capture whose lens is taken away: what is written, what is linked, what is told."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.wrong_lens import found, without_lens


def test_a_copy_says_nothing_of_the_lens_and_the_capture_stays(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    (capture / "images").mkdir(parents=True)
    said = {"fl_x": 50.0, "k1": 0.1, "p2": 0.01, "frames": [{"file_path": "images/a.png", "k2": 0.2, "w": 4}]}
    (capture / "transforms.json").write_text(json.dumps(said))
    for _ in range(2):  # again over what is there
        copy = without_lens(capture, tmp_path / "out")
    assert json.loads((copy / "transforms.json").read_text()) == {
        "fl_x": 50.0,
        "frames": [{"file_path": "images/a.png", "w": 4}],
    }
    assert (copy / "images").resolve() == capture / "images"
    assert json.loads((capture / "transforms.json").read_text()) == said


def test_what_was_found_is_told_as_far_as_it_was_learned(tmp_path: Path) -> None:
    assert found(tmp_path) == ""
    for zoom, told in (
        ([1.01, 0.0, 0.0], "x 1.0100"),
        ([1.01, 0.0, 0.0, -0.02, 0.003], "x 1.0100, k1 -0.0200, k2 +0.0030"),
    ):
        (tmp_path / "poses.json").write_text(json.dumps({"frames": [{"zoom": zoom}]}))
        assert found(tmp_path) == told
    (tmp_path / "poses.json").write_text(json.dumps({"frames": [{}]}))
    assert found(tmp_path) == ""
