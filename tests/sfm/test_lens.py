"""The final lens model of cameras, on synthetic models."""

from __future__ import annotations

from typing import Any

import pytest

from gs2d.sfm.lens import RICH, START, is_plausible, with_rich_lenses
from synthetic_model import HEIGHT, WIDTH, synthetic_model

F, CX, CY = 520.0, 320.0, 240.0


@pytest.mark.parametrize(
    ("params", "plausible"),
    [
        ((F, CX, CY, 0.0, 0.0), True),
        ((F, CX, CY, -0.24, 0.28), True),  # sceaux_castle
        ((F, CX, CY, -0.9, 0.0), False),  # the radius turns at r = 0.61 < 0.77
        ((F, CX, CY, 0.9, 0.0), False),  # k r^2 = 0.9 (400 / 520)^2 = 0.53 at the corner
        ((float("nan"), CX, CY, 0.0, 0.0), False),
    ],
)
def test_implausible_lenses_are_recognised(params: tuple[float, ...], plausible: bool) -> None:
    assert is_plausible(params, WIDTH, HEIGHT) is plausible


def placed_with_start(pycolmap: Any, params: tuple[float, ...]) -> Any:
    piece = synthetic_model(pycolmap, RICH, params)
    camera = piece.camera(1)
    camera.model = getattr(pycolmap.CameraModelId, START)
    camera.params = [F, CX, CY, 0.0]
    pycolmap.bundle_adjustment(piece, pycolmap.BundleAdjustmentOptions())
    return piece


def test_a_camera_with_enough_images_gets_a_second_coefficient(pycolmap: Any) -> None:
    piece = placed_with_start(pycolmap, (F, CX, CY, -0.25, 0.3))
    before = piece.compute_mean_reprojection_error()
    rich = with_rich_lenses(pycolmap, piece, threads=1)
    assert rich.camera(1).model.name == RICH
    assert rich.camera(1).params[3:] == pytest.approx([-0.25, 0.3], abs=0.05)
    assert rich.camera(1).focal_length_x == pytest.approx(F, rel=0.01)
    assert rich.compute_mean_reprojection_error() < before
    assert rich.num_reg_images() == 12


def test_a_camera_with_few_images_keeps_its_lens(pycolmap: Any) -> None:
    piece = placed_with_start(pycolmap, (F, CX, CY, -0.1, 0.0))
    for image in sorted(piece.images.values(), key=lambda image: image.name)[7:]:
        piece.deregister_frame(image.frame_id)
    assert with_rich_lenses(pycolmap, piece, threads=1) is piece
