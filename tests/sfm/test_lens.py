"""Choice of the lens model by plausibility and held-out observations, on synthetic models."""

from __future__ import annotations

from typing import Any

import pytest

from gs2d.sfm.lens import BENT, MODELS, Trial, apply, choose, doubts, try_lenses
from synthetic_model import HEIGHT, WIDTH, synthetic_model

F, CX, CY = 520.0, 320.0, 240.0


@pytest.fixture(scope="module")
def pycolmap(colmap: None) -> Any:
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    return pycolmap


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("SIMPLE_PINHOLE", (F, CX, CY), []),
        ("SIMPLE_RADIAL", (F, CX, CY, -0.15), []),
        ("RADIAL", (F, CX, CY, -0.24, 0.28), []),  # sceaux_castle
        ("OPENCV", (F, F * 1.01, CX, CY, -0.1, 0.02, 0.002, -0.003), []),
        ("OPENCV_FISHEYE", (300.0, 300.0, CX, CY, 0.02, 0.0, 0.0, 0.0), []),
        ("OPENCV", (1298.8, 1447.9, CX, CY, 0, 0, 0, 0), ["fx / fy is 0.897, but pixels are square"]),
        ("OPENCV", (F, F, CX, CY, 0, 0, -0.0175, 0), ["the tangential distortion is -0.0175"]),
        ("SIMPLE_RADIAL_FISHEYE", (150.0, CX, CY, 0.01), []),  # 214 degrees from corner to corner
        ("SIMPLE_FISHEYE", (60.0, CX, CY), ["the focal length is 0.09 of the longer side"]),
        ("SIMPLE_RADIAL_FISHEYE", (200.0, CX, CY, -0.3), ["the distortion is not monotonic within the image"]),
        ("SIMPLE_PINHOLE", (F, CX + 80, CY), ["the principal point is 12 % of the size off the image centre"]),
        ("SIMPLE_PINHOLE", (100.0, CX, CY), ["the focal length is 0.16 of the longer side"]),
        ("SIMPLE_PINHOLE", (9000.0, CX, CY), ["the focal length is 14.06 of the longer side"]),
        ("SIMPLE_RADIAL", (F, CX, CY, -0.9), ["the distortion is not monotonic within the image"]),
        ("SIMPLE_RADIAL", (F, CX, CY, 0.9), ["the distortion moves the corner by 53 %"]),
        ("SIMPLE_PINHOLE", (float("nan"), CX, CY), ["invalid parameters"]),
    ],
)
def test_implausible_lenses_have_doubts(
    pycolmap: Any, model: str, params: tuple[float, ...], expected: list[str]
) -> None:
    """k r^2 = 0.9 (400 / 520)^2 = 0.53 at the corner; with -0.9 the radius turns at r = 0.61 < 0.77."""
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=list(params))
    assert doubts(camera) == expected


def trial(model: str, error: float, *doubted: str) -> Trial:
    return Trial(model, error, doubted, {}, {})


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", (F, CX, CY)),
        ("SIMPLE_RADIAL", (F, CX, CY, -0.12)),
        ("RADIAL", (F, CX, CY, -0.25, 0.3)),
        ("OPENCV", (F, F, CX, CY, -0.1, 0.05, 0.006, -0.008)),
    ],
)
def test_the_true_lens_is_chosen(pycolmap: Any, model: str, params: tuple[float, ...]) -> None:
    """The model was estimated with SIMPLE_RADIAL."""
    piece = synthetic_model(pycolmap, model, params)
    steps: list[int] = []
    apply(pycolmap, piece, Trial("SIMPLE_RADIAL", 0, (), {1: [F, CX, CY, 0.0]}, {1: "SIMPLE_RADIAL"}), threads=1)
    trials = try_lenses(pycolmap, piece, seed=0, threads=1, on_done=steps.append)
    best = choose(trials)
    assert best.model == model
    assert steps == [1, 2, 3, 4]
    assert best.error < 0.6  # noise of 0.3 px per axis: 0.38 on average, plus the error of the points
    apply(pycolmap, piece, best, threads=1)
    camera = piece.camera(1)
    assert camera.model.name == model
    assert camera.focal_length_x == camera.focal_length_y == pytest.approx(F, rel=0.01)
    assert piece.num_reg_images() == 12


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_FISHEYE", (280.0, CX, CY)),
        ("SIMPLE_RADIAL_FISHEYE", (280.0, CX, CY, -0.12)),
    ],
)
def test_the_true_fisheye_is_chosen(pycolmap: Any, model: str, params: tuple[float, ...]) -> None:
    """The model was estimated with SIMPLE_RADIAL_FISHEYE: only fisheye models are compared."""
    piece = synthetic_model(pycolmap, model, params)
    first = [280.0, CX, CY, 0.0]
    apply(pycolmap, piece, Trial("SIMPLE_RADIAL_FISHEYE", 0, (), {1: first}, {1: "SIMPLE_RADIAL_FISHEYE"}), threads=1)
    trials = try_lenses(pycolmap, piece, seed=0, threads=1, on_done=lambda _: None)
    assert [trial.model for trial in trials] == [BENT[model] for model in MODELS]
    best = choose(trials)
    assert best.model == model
    assert not best.doubts
    assert best.error < 0.6
    apply(pycolmap, piece, trials[-1], threads=1)  # OPENCV_FISHEYE keeps fx = fy
    camera = piece.camera(1)
    assert camera.model.name == "OPENCV_FISHEYE"
    assert camera.focal_length_x == camera.focal_length_y == pytest.approx(280, rel=0.02)
