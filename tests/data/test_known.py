"""Invalid pixels after undistortion are never trained, scored, fused or shown."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from capture_writers import ring, small_colmap
from gs2d.core.splats import Splats
from gs2d.data import View, load_scene
from gs2d.data.undistort import colmap_intrinsics, source_positions
from gs2d.pipeline.finish import run_mesh as surface
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.pipeline.prepare.options import MeshOptions
from gs2d.render.backends import get_backend
from gs2d.render.types import RasterSettings
from gs2d.training.events import ignore
from gs2d.training.targets import DeviceTargets, Targets

WIDTH, HEIGHT = 160, 120
PINCUSHION = (110.0, 80.0, 60.0, 0.3)  # the corners of the pinhole picture lie beyond the photograph


def distorted(root: Path, params: tuple[float, ...] = PINCUSHION, *, mask: bool = False) -> View:
    """The first view of a capture with a SIMPLE_RADIAL lens; all photographs are plain grey."""
    small_colmap(root, count=3, cameras={7: ("SIMPLE_RADIAL", WIDTH, HEIGHT, params)})
    (root / "masks").mkdir()
    half = np.zeros((HEIGHT, WIDTH), np.uint8)
    half[:, :80] = 255
    for i in range(3):
        Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)).save(root / f"images/{i}.png")
        if mask:
            Image.fromarray(half).save(root / f"masks/{i}.png")
    return load_scene(root, test_every=0).train[0]


def reached() -> np.ndarray:
    """Where the photograph has pixels."""
    return source_positions(colmap_intrinsics("camera", "SIMPLE_RADIAL", WIDTH, HEIGHT, PINCUSHION))[1]


def test_pixels_outside_the_photograph_are_invalid_and_masked(tmp_path: Path) -> None:
    plain, masked = distorted(tmp_path / "a"), distorted(tmp_path / "b", mask=True)
    for view in (plain, masked):
        np.testing.assert_array_equal(view.valid(), reached())
        assert not view.valid()[0, 0]
        assert (view.image()[~view.valid()] == 0).all()
        np.testing.assert_array_equal(view.usable(masks=False), reached())
    np.testing.assert_array_equal(plain.mask(), reached())
    assert masked.mask()[60, 40]
    assert not masked.mask()[60, 120]
    assert masked.valid()[60, 120]
    np.testing.assert_array_equal(masked.usable(masks=True), masked.mask())


def test_a_downscaled_pixel_is_valid_if_its_whole_block_is(tmp_path: Path) -> None:
    distorted(tmp_path)
    view = load_scene(tmp_path, test_every=0, downscale=4).train[0]
    blocks = reached().reshape(HEIGHT // 4, 4, WIDTH // 4, 4).all(axis=(1, 3))
    np.testing.assert_array_equal(view.valid(), blocks)


def images(unknown: int) -> View:
    """A view of 8 x 8 pixels, of which the left half is unknown and has this value."""
    image = np.full((8, 8, 3), 200, np.uint8)
    image[:, :4] = unknown
    valid = np.ones((8, 8), bool)
    valid[:, :4] = False
    camera = ring(1, width=8, height=8, f=8.0)[0]
    return View.from_arrays("a", camera, image, valid=valid)


@pytest.mark.parametrize("use_masks", [True, False])
def test_invalid_pixels_are_never_trained_or_scored(use_masks: bool) -> None:
    view = images(0)
    black = (0.0, 0.0, 0.0)
    made: list[Any] = [
        Targets([view], black, use_masks=use_masks)[0],
        DeviceTargets([view], black, use_masks=use_masks, device=torch.device("cpu"))[0],
    ]
    for target in made:
        np.testing.assert_array_equal(target.mask.numpy(), view.valid())


@pytest.mark.parametrize("use_masks", [True, False])
def test_the_depth_of_invalid_pixels_is_not_fused(use_masks: bool) -> None:
    view = images(0)
    splat = Splats(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[0.7, 0.0, 0.7, 0.0]]),
        log_scales=torch.full((1, 2), 2.0),
        opacity_logits=torch.tensor([9.0]),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 0, 3),
    )
    scene: Any = SimpleNamespace(train=(view,))
    protocol: Any = SimpleNamespace(use_mask_in_fusion=use_masks, fusion=SimpleNamespace(subject=False))
    trained = Trained(splat, scene, protocol, RasterSettings(sh_degree=0), get_backend("reference"))
    frame = next(iter(surface._frames(trained, MeshOptions(depth="median", whole_scene=True), ignore)))
    assert frame.valid is not None
    assert frame.valid[:, 4:].any()
    assert not frame.valid[:, :4].any()
