"""The section about the cameras from structure from motion."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gs2d.data.image_files import write_image
from gs2d.errors import DataError
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.capture_section import capture_section

FOUND: dict[str, Any] = {
    "count": 3,
    "placed": 2,
    "points": 1234,
    "photos_per_point": 4.25,
    "mean_error_px": 0.82,
    "cameras": [{"about": "SIMPLE_RADIAL of 2 photographs, 1000x1000, f = 1317 px (42 degrees wide)"}],
    "photographs": [
        {"source": "a.jpg", "placed": True, "features": 4000},
        {"source": "b.jpg", "placed": True, "features": 4000},
        {"source": "<c>.jpg", "placed": False, "features": 2100, "reason": "21 matches with a.jpg at best"},
    ],
}


def capture(folder: Path, found: dict[str, Any]) -> Path:
    folder.mkdir(parents=True)
    (folder / "poses.json").write_text(json.dumps(found))
    write_image(folder / "poses.png", np.full((60, 120, 3), 0.5))
    return folder


def test_the_report_has_unplaced_photographs_cameras_and_image(tmp_path: Path) -> None:
    capture(tmp_path / "capture", FOUND)
    html = str(capture_section(RunRecord(tmp_path, {"scene": {"path": str(tmp_path)}})))
    assert "2 of 3 photographs have a camera. There are 1,234 sparse points" in html
    assert "&lt;c&gt;.jpg" in html
    assert "21 matches with a.jpg at best" in html
    assert "f = 1317 px" in html
    assert "data:image/jpeg;base64," in html


def test_a_capture_outside_the_run_is_read_by_its_path(tmp_path: Path) -> None:
    found = {**FOUND, "placed": 2, "count": 2, "photographs": FOUND["photographs"][:2]}
    there = capture(tmp_path / "elsewhere", found)
    html = str(capture_section(RunRecord(tmp_path / "run", {"scene": {"path": str(there)}})))
    assert "2 of 2 photographs" in html
    assert "without a camera" not in html


def test_cameras_from_elsewhere_have_no_section(tmp_path: Path) -> None:
    assert capture_section(RunRecord(tmp_path, {"scene": {"path": str(tmp_path)}})) is None


def test_a_missing_image_is_reported_and_a_broken_file_is_an_error(tmp_path: Path) -> None:
    folder = capture(tmp_path / "capture", FOUND)
    (folder / "poses.png").unlink()
    assert "poses.png cannot be shown" in str(capture_section(RunRecord(tmp_path, {"scene": {"path": str(tmp_path)}})))
    (folder / "poses.json").write_text("{}")
    with pytest.raises(DataError, match=r"poses\.json is damaged"):
        capture_section(RunRecord(tmp_path, {"scene": {"path": str(tmp_path)}}))
