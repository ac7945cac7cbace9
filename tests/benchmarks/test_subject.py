"""What benchmarks/subject.py says of meshes whose parts lie in masks, beside them, or in no picture."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import subject

from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from tiny import ball_image

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
