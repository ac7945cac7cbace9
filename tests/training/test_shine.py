"""Shiny surface: brightness that changes with the direction of view counts as missing texture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from gs2d.config.protocols import GENERIC
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene, View
from gs2d.errors import BackendError
from gs2d.kernels.library import ready_library
from gs2d.meshing.warped_ncc import GreyImage
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.training.robust.shine import CELLS, shine_maps
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer, TrainerOptions
from saved_states import resumed_everywhere
from together import robust
from train_toys import full_state, random_splats
from wall_scene import HEIGHT, WALL, WIDTH, flat_wall, wall


def on_the_wall(camera: Camera) -> np.ndarray:
    """Return x of the wall at each pixel [H, W]; all pixels of the wall scene see it."""
    x, y = (np.arange(WIDTH) + 0.5 - camera.cx) / camera.fx, (np.arange(HEIGHT) + 0.5 - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((HEIGHT, WIDTH))], axis=-1) @ camera.rotation
    return np.asarray(camera.center[0] + rays[..., 0] * (WALL - camera.center[2]) / rays[..., 2])


def with_reflection(scene: Scene) -> Scene:
    """Add light to the right third of the wall, more in later photographs, as the direction of view changes."""
    views = []
    for row, view in enumerate(scene.train):
        image = np.array(view.target((0.0, 0.0, 0.0)))
        shiny = on_the_wall(view.camera) > 0.6
        image[shiny] = 0.3 * image[shiny] + 0.15 * row
        views.append(View.from_arrays(view.name, view.camera, np.rint(255 * image).astype(np.uint8)))
    return replace(scene, train=tuple(views))


def maps_of(scene: Scene, neighbours: Sequence[Sequence[int]]) -> torch.Tensor:
    try:
        library = ready_library()
    except BackendError:
        pytest.skip("the native library is not built")

    def rendered(row: int) -> tuple[GreyImage, np.ndarray]:
        view = scene.train[row]
        output = rasterize(flat_wall(), view.camera, RasterSettings().for_depths("transmittance"), backend="reference")
        return GreyImage(view.camera, view.target((0.0, 0.0, 0.0)).mean(axis=2)), output.depth("transmittance").numpy()

    return shine_maps(rendered, neighbours, library)


BESIDE = ((1, 2), (0, 2), (1, 3), (2, 4), (3, 2))


def test_a_reflection_is_shiny_and_the_wall_beside_it_is_matt() -> None:
    assert maps_of(wall(), BESIDE).float().mean() < 10
    scene = with_reflection(wall())
    maps = maps_of(scene, BESIDE)
    assert maps.shape == (5, CELLS, CELLS)
    for view, shine in zip(scene.train, maps, strict=True):
        x = on_the_wall(view.camera)
        at = F.interpolate(shine[None, None].float(), x.shape)[0, 0].numpy()
        assert at[x > 0.9].mean() > 150
        assert at[(x > -1.0) & (x < 0.2)].mean() < 80


def test_exposure_is_not_shine_and_photographs_without_neighbours_are_matt() -> None:
    assert maps_of(wall((1.0, 0.7, 0.9, 0.8, 1.0)), BESIDE).float().mean() < 10
    assert not maps_of(with_reflection(wall()), ((), (), (), (), ())).any()


def test_shiny_pixels_count_as_pixels_without_texture() -> None:
    state, flat = full_state(), torch.full((8, 12), 40, dtype=torch.uint8)
    assert state.bare(0, flat) is flat
    state.maps["shine"] = torch.zeros((2, CELLS, CELLS), dtype=torch.uint8)
    state.maps["shine"][1, :, : CELLS // 2] = 200
    assert state.bare(1, None) is None
    assert torch.equal(state.bare(0, flat), flat)
    both = state.bare(1, flat)
    assert both.dtype == torch.uint8
    assert (both[:, :5] == 200).all()
    assert (both[:, 7:] == 40).all()
    assert torch.equal(TrainState.from_state_dict(state.state_dict()).maps["shine"], state.maps["shine"])


def test_training_finds_shine_and_resumes_with_it() -> None:
    recipe, scene = robust(), with_reflection(wall())
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", init=flat_wall())
    trainer.run()
    assert trainer.state.maps["shine"].float().mean() > 20
    resumed_everywhere(scene, recipe, "cpu", every=4)


def test_frozen_splats_show_the_surface_too() -> None:
    scene, few = with_reflection(wall()), random_splats(5)
    few.opacity_logits[:] = -4.0
    frozen = Splats(**{**dict(flat_wall().items()), "shN": torch.zeros(len(flat_wall()), 3, 3)})
    trainer = Trainer(scene, robust(), GENERIC, backend="cpu", init=few, options=TrainerOptions(frozen=frozen))
    trainer.run()
    assert trainer.state.maps["shine"].float().mean() > 20
