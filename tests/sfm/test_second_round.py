"""The second round: which pairs are compared again, and which photographs the model does not support."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gs2d.sfm.second_round import MIN_SEEN, refuse_unsupported
from synthetic_model import synthetic_model

LENS = (520.0, 320.0, 240.0)


@pytest.fixture(scope="module")
def pycolmap(colmap: None) -> Any:
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    return pycolmap


def test_a_photograph_that_the_model_supports_stays(pycolmap: Any) -> None:
    piece = synthetic_model(pycolmap, "SIMPLE_PINHOLE", LENS)
    assert refuse_unsupported(piece, ["003.jpg", "not placed.jpg"]) == {}
    assert piece.num_reg_images() == 12


def test_a_photograph_in_a_wrong_place_is_taken_out(pycolmap: Any) -> None:
    """Moved so that what it shows is many pixels off."""
    piece = synthetic_model(pycolmap, "SIMPLE_PINHOLE", LENS)
    image = next(image for image in piece.images.values() if image.name == "003.jpg")
    pose = image.cam_from_world()
    moved = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0.02, 0.0, 0.0]))
    image.frame.rig_from_world = moved
    refused = refuse_unsupported(piece, ["003.jpg", "004.jpg"])
    assert list(refused) == ["003.jpg"]
    assert "px off where it fits best (0." in refused["003.jpg"]
    assert {im.name for im in piece.images.values() if im.has_pose} == {f"{i:03}.jpg" for i in range(12) if i != 3}


def test_photographs_that_agree_with_each_other_only_are_taken_out(pycolmap: Any) -> None:
    """Four share points that none of the others sees, as photographs of another room do."""
    piece = synthetic_model(pycolmap, "SIMPLE_PINHOLE", LENS)
    new = {image.image_id for image in piece.images.values() if image.name >= "008.jpg"}
    for number in sorted(piece.point3D_ids()):
        elements = [(e.image_id, e.point2D_idx) for e in piece.point3D(number).track.elements]
        apart = new if number % 2 else {i for i, _ in elements} - new
        for image, index in elements:
            if image not in apart and piece.exists_point3D(number):
                piece.delete_observation(image, index)
    refused = refuse_unsupported(piece, [f"{i:03}.jpg" for i in range(8, 12)])
    assert sorted(refused) == ["008.jpg", "009.jpg", "010.jpg", "011.jpg"]
    assert refused["008.jpg"].startswith("only 0 points of known place agree")
    assert f"expected {MIN_SEEN} or more" in refused["008.jpg"]
    assert piece.num_reg_images() == 8
