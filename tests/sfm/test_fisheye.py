"""Fisheye images with unknown focal length (``--camera-model OPENCV_FISHEYE``)."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.wide_captures import errors, write_photographs

from gs2d.core.camera import look_at
from gs2d.pipeline.prepare.options import PosesOptions
from gs2d.pipeline.prepare.pose_finding import find_poses
from gs2d.sfm.lens import fisheye_focal

SIZE = (400, 300)
F = 150.0


class _Database:
    """Matches between images of random points through a lens, with 0.3 px noise and a tenth of outliers."""

    def __init__(self, pycolmap: Any, model: str, params: tuple[float, ...], *, count: int = 4) -> None:
        rng = np.random.default_rng(0)
        lens = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=list(params))
        points = rng.normal(size=(900, 3))
        points *= rng.uniform(2, 5, (900, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
        self._seen, self._pycolmap = [], pycolmap
        for i in range(count):
            eye = np.array([0.8 * i - 1.2, 0.3 * np.sin(2 * i), 0.2 * i])
            ahead = eye + np.array([0.3 * i - 0.4, 3.0, 0.0])
            T = look_at(eye, ahead, np.array([0, 0, 1.0]), width=8, height=8, fx=8).T_cam_world
            at = [lens.img_from_cam(T[:3, :3] @ p + T[:3, 3]) for p in points]
            places = np.array([np.full(2, np.nan) if p is None else p for p in at]) + rng.normal(0, 0.3, (900, 2))
            inside = ((places > 0) & (places < SIZE)).all(axis=1)
            self._seen.append(np.where(inside[:, None], places, np.nan))
        self._rng = rng

    def read_all_images(self) -> list[Any]:
        return [SimpleNamespace(image_id=i + 1, camera_id=1) for i in range(len(self._seen))]

    def read_two_view_geometry_num_inliers(self) -> tuple[list[int], list[int]]:
        pairs = [(i, j) for j in range(len(self._seen)) for i in range(j)]
        numbers = [self._pycolmap.image_pair_to_pair_id(i + 1, j + 1) for i, j in pairs]
        return numbers, [len(self.read_matches(i + 1, j + 1)) for i, j in pairs]

    def read_matches(self, first: int, second: int) -> np.ndarray:
        both = np.flatnonzero(np.isfinite(self._seen[first - 1] + self._seen[second - 1]).all(axis=1))
        other = both.copy()
        other[::10] = np.roll(both, 7)[::10]
        return np.stack([both, other], axis=1).astype(np.uint32)

    def read_keypoints(self, image: int) -> np.ndarray:
        return np.nan_to_num(self._seen[image - 1]).astype(np.float32)


@pytest.mark.parametrize(
    ("model", "params", "focal"),
    [
        ("SIMPLE_RADIAL_FISHEYE", (F, 200, 150, 0.02), F),  # 153 degrees from left to right
        ("SIMPLE_FISHEYE", (240.0, 200, 150), 240.0),  # 119 degrees from corner to corner
    ],
)
def test_matches_determine_the_focal_length_of_a_fisheye(
    pycolmap: Any, model: str, params: tuple[float, ...], focal: float
) -> None:
    camera = pycolmap.Camera(model="SIMPLE_FISHEYE", width=SIZE[0], height=SIZE[1], params=[F, 200, 150], camera_id=1)
    found = fisheye_focal(pycolmap, _Database(pycolmap, model, params), camera, seed=0)
    assert found == pytest.approx(focal, rel=0.12)


@pytest.mark.slow
@pytest.mark.parametrize(("angle", "fits"), [(150, "diagonal"), (185, "height")])
def test_fisheyes_are_placed(colmap: None, tmp_path: Path, angle: int, fits: str) -> None:
    """Measured at 16 of 800 px: an error of 0.4 mm in a room of 4 m."""
    truth = write_photographs(tmp_path / "photos", "fisheye", count=8, width=480, angle=angle, fits=fits)
    lens: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE", "feature_size": 320}
    made = find_poses(PosesOptions(photos=tmp_path / "photos", out=tmp_path / "capture", threads=2, **lens))
    off = errors(tmp_path / "capture", truth)
    assert off["placed"] == 8
    assert off["centres_worst_m"] < 0.01
    assert off["turned_worst_degrees"] < 0.3
    assert made["lens"] == {"chosen": "OPENCV_FISHEYE", "asked": "OPENCV_FISHEYE"}
