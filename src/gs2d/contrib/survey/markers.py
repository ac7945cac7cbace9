"""Scale from printed ArUco markers of known size, detected by OpenCV (extra ``markers``)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gs2d.contrib.survey.triangulate import triangulate
from gs2d.core.extras import install, required
from gs2d.data import View
from gs2d.data.image_files import read_image
from gs2d.errors import BackendError, DataError

DICTIONARIES = {
    **{f"{n}x{n}_{count}": f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "aruco_original": "DICT_ARUCO_ORIGINAL",
    "apriltag_36h11": "DICT_APRILTAG_36h11",
}
MAX_PIXELS = 3.0  # largest reprojection error of a corner
MAX_PLANARITY = 0.1  # largest deviation from a parallelogram, relative to the side


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker in the run: corners [4, 3], mean side in units of the run, and number of photographs."""

    number: int
    corners: np.ndarray
    side: float
    photographs: int


def required_cv2() -> Any:
    """Return the package cv2, with ArUco, or raise BackendError."""
    cv2 = required("markers", "cv2", "--markers")
    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        raise BackendError(
            f"--markers needs OpenCV 4.7 or newer with ArUco, got {cv2.__version__}; {install('markers')}"
        )
    return cv2


def detector(dictionary: str) -> Any:
    """Return OpenCV's detector of a dictionary."""
    cv2 = required_cv2()
    if dictionary not in DICTIONARIES:
        raise DataError(f"marker_dictionary must be one of {', '.join(DICTIONARIES)}, got {dictionary}")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    predefined = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARIES[dictionary]))
    return cv2.aruco.ArucoDetector(predefined, parameters)


def detected(aruco: Any, view: View) -> dict[int, np.ndarray]:
    """Detect markers in a photograph: corners [4, 2] px, by number.

    Numbers that occur more than once are ignored.
    """
    if view.path is None:
        return {}
    image = read_image(view.path)
    grey = np.ascontiguousarray(image[:, :, :3].mean(axis=2).astype(np.uint8))
    corners, numbers, _ = aruco.detectMarkers(grey)
    if numbers is None:
        return {}
    every = [int(number) for number in np.ravel(numbers)]
    return {  # the origin of OpenCV is the centre of the first pixel
        number: np.asarray(c, np.float64).reshape(4, 2) + 0.5
        for number, c in zip(every, corners, strict=True)
        if every.count(number) == 1
    }


def in_run(detections: Iterable[tuple[View, dict[int, np.ndarray]]]) -> tuple[list[Marker], list[str]]:
    """Locate the markers that are visible in two photographs; return them and a reason for each rejected one."""
    by_number: dict[int, list[tuple[View, np.ndarray]]] = {}
    for view, markers in detections:
        for number, corners in markers.items():
            by_number.setdefault(number, []).append((view, corners))
    located: list[Marker] = []
    rejected: list[str] = []
    for number, marks in sorted(by_number.items()):
        if len(marks) < 2:
            rejected.append(f"marker {number} is in one photograph only")
            continue
        try:
            corners, worst = _corners(number, marks)
        except DataError as error:
            rejected.append(str(error))
            continue
        sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
        bend = float(np.linalg.norm(corners[0] - corners[1] + corners[2] - corners[3]))
        if worst > MAX_PIXELS or bend > MAX_PLANARITY * sides.mean():
            rejected.append(f"marker {number} moved between photographs, or exists twice (error {worst:.1f} px)")
            continue
        located.append(Marker(number, corners, float(sides.mean()), len(marks)))
    return located, rejected


def _corners(number: int, marks: Sequence[tuple[View, np.ndarray]]) -> tuple[np.ndarray, float]:
    """Return the four corners in the run, and the largest median reprojection error, px."""
    views = [view for view, _ in marks]
    points = [
        triangulate(views, np.array([corners[k] for _, corners in marks]), f"corner {k} of marker {number}")
        for k in range(4)
    ]
    return np.array([point.point for point in points]), max(float(np.median(point.pixels)) for point in points)
