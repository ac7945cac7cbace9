"""Printed markers: detection and size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gs2d.contrib.survey.markers import detected, detector, in_run
from gs2d.core.camera import Camera, look_at
from gs2d.data import View
from gs2d.errors import DataError

cv2 = pytest.importorskip("cv2")
SIDE = 0.37  # of a marker, in units of the run


def sheet() -> np.ndarray:
    """Two markers on white paper: 600 px, of which each takes 200; the paper is 3 sides wide."""
    paper = np.full((600, 600), 255, np.uint8)
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, (row, column) in ((3, (50, 50)), (7, (350, 350))):
        paper[row : row + 200, column : column + 200] = cv2.aruco.generateImageMarker(known, number, 200)
    return paper


def photograph(camera: Camera, path: Path) -> View:
    corners = np.array([[-1.5, -1.5, 0], [1.5, -1.5, 0], [1.5, 1.5, 0], [-1.5, 1.5, 0]]) * SIDE * (1, -1, 1)
    local = corners @ camera.rotation.T + camera.T_cam_world[:3, 3]
    pixels = local[:, :2] / local[:, 2:] * camera.fx + (camera.cx, camera.cy)
    inner = np.array([[0, 0], [600, 0], [600, 600], [0, 600]], np.float32) - 0.5
    H = cv2.getPerspectiveTransform(inner, (pixels - 0.5).astype(np.float32))
    grey = cv2.warpPerspective(sheet(), H, (camera.width, camera.height), borderValue=200, flags=cv2.INTER_AREA)
    Image.fromarray(np.repeat(grey[..., None], 3, axis=2)).save(path)
    return View(path.name, camera, lambda: None, path=path)  # type: ignore[arg-type,return-value]


def views(folder: Path) -> list[View]:
    eyes = [(0.3, -1.2, 1.6), (1.1, 0.2, 1.5), (-0.9, 0.7, 1.7), (0.1, 0.1, 2.0)]
    up = np.array([0.0, 0.0, 1.0])
    return [
        photograph(look_at(np.array(eye), np.zeros(3), up, width=640, height=640, fx=640.0), folder / f"{k}.png")
        for k, eye in enumerate(eyes)
    ]


def test_markers_have_their_size_in_the_run_to_a_fraction_of_a_percent(tmp_path: Path) -> None:
    found = detector("4x4_50")
    markers, left = in_run((view, detected(found, view)) for view in views(tmp_path))
    assert [marker.number for marker in markers] == [3, 7]
    assert left == []
    for marker in markers:
        assert marker.side == pytest.approx(SIDE, rel=4e-3)
        assert np.abs(marker.corners[:, 2]).max() < 0.01 * SIDE


def test_a_marker_in_one_photograph_is_left_out_and_reported(tmp_path: Path) -> None:
    found = detector("4x4_50")
    markers, left = in_run((view, detected(found, view)) for view in views(tmp_path)[:1])
    assert markers == []
    assert left == ["marker 3 is in one photograph only", "marker 7 is in one photograph only"]
    with pytest.raises(DataError, match="marker_dictionary"):
        detector("no_such")
