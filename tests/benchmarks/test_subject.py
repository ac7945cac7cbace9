"""What benchmarks/subject.py says of meshes whose parts lie in masks, beside them, or in no picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks import subject
from PIL import Image

from ball_runs import options
from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from gs2d.errors import DataError
from gs2d.pipeline.train import train
from tiny import ball_image, write_ball_mesh, write_capture

ON_X, ON_Y = [(3, 0, 0), (-3, 0, 0)], [(0, 3, 0), (0, -3, 0), (0.5, 3, 0)]


def masks(places: list[tuple[float, float, float]]) -> list[tuple[Camera, np.ndarray]]:
    """Cameras that look at the ball of radius 0.8 at the origin, and its silhouettes."""
    found = []
    for place in places:
        camera = look_at(np.array(place, float), np.zeros(3), np.array([0.0, 0.0, 1.0]), width=80, height=80, fx=100.0)
        found.append((camera, ball_image(camera)[..., 3] > 0))
    return found


def squares(*corners: tuple[float, float, float], side: float = 0.1) -> Mesh:
    """Squares across z, each with a corner there and of its side."""
    steps = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * side
    vertices = np.concatenate([np.array(corner) + steps for corner in corners])
    faces = np.concatenate([4 * i + np.array([[0, 1, 2], [0, 2, 3]]) for i in range(len(corners))])
    return Mesh(vertices, faces.astype(np.int32))


def test_area_counts_as_inside_where_half_of_the_pictures_that_show_it_have_it_in_the_mask() -> None:
    middle, above, nowhere, beside = (0, 0, 0), (0, 0, 1.0), (0, 0, 40), (0.95, -0.05, 0)
    fraction = subject.fraction_inside(squares(middle, middle, above, nowhere), masks(ON_X + ON_Y))
    assert (fraction.masks, fraction.faces, fraction.inside_faces) == (5, 8, 4)
    assert (fraction.area, fraction.inside, fraction.unseen) == pytest.approx((0.04, 0.5, 0.25))
    assert subject.fraction_inside(squares(beside), masks(ON_X + ON_Y[:2])).inside == 1.0  # two of four
    assert subject.fraction_inside(squares(beside), masks(ON_X + ON_Y)).inside == 0.0  # two of five


def test_the_share_is_of_the_area_and_not_of_the_number_of_faces() -> None:
    small, large = squares((0, 0, 0)), squares((0.0, 0.0, 0.9), side=0.2)
    both = Mesh(np.concatenate([small.vertices, large.vertices]), np.concatenate([small.faces, large.faces + 4]))
    assert subject.fraction_inside(both, masks(ON_X + ON_Y)).inside == pytest.approx(0.2)


def test_without_masks_or_area_there_is_no_share() -> None:
    with pytest.raises(DataError, match="got 0 masks"):
        subject.fraction_inside(squares((0, 0, 0)), [])
    with pytest.raises(DataError, match="and 0 faces"):
        subject.fraction_inside(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32)), masks(ON_X))


def test_the_masks_of_a_folder_judge_the_mesh_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = write_capture(tmp_path / "ball", size=48)
    train(options(capture, tmp_path / "run"))
    write_ball_mesh(tmp_path / "ball.ply")
    for name, turned in (("ball_masks", False), ("other_masks", True)):
        (tmp_path / name / "train").mkdir(parents=True)
        for path in sorted((capture / "train").iterdir())[:4]:
            alpha = np.asarray(Image.open(path))[..., 3]
            Image.fromarray(255 - alpha if turned else alpha).save(tmp_path / name / "train" / f"{path.stem}_mask.png")
        out = tmp_path / f"{name}.json"
        words = [str(tmp_path / "run"), "--mesh", str(tmp_path / "ball.ply"), "--masks", str(tmp_path / name)]
        subject.main([*words, "--out", str(out)])
        said, found = capsys.readouterr().out, json.loads(out.read_text())
        assert found["masks"] == 4
        assert found["inside"] == pytest.approx(0.0 if turned else 1.0, abs=0.02)  # but for the rims of pixels
        assert f"{found['inside']:.1%} of the mesh's area is in the masks of 4 photographs" in said
    (tmp_path / "empty").mkdir()
    with pytest.raises(SystemExit, match="got 0 masks"):
        subject.main([str(tmp_path / "run"), "--masks", str(tmp_path / "empty")])
