"""Gradients of a scene that was trained: float32 against the float64 build of the same sources, by quantiles.

Scenes of a few random splats (tests/render/test_parity.py) have neither the hundreds of faint layers of a trained one
nor its sizes of a pixel; there sums cancel, and decisions at thresholds flip for single pairs.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from gs2d.config.presets import get_recipe
from gs2d.config.protocols import NERF_SYNTHETIC
from gs2d.config.schedule import scale_schedule
from gs2d.core.camera import look_at
from gs2d.core.splats import ATTRIBUTES, Splats
from gs2d.data.scene import Scene, View
from gs2d.kernels.library import Library
from gs2d.render import cpu
from gs2d.render.types import RasterSettings
from gs2d.training.trainer import Trainer
from render_scenes import requiring_grad
from tiny import ball_image

SIDE, ITERATIONS = 96, 300


@pytest.fixture(scope="module")
def trained() -> tuple[Scene, Splats, RasterSettings]:
    """The mottled ball, trained on until normals have been made consistent for a while."""
    views = []
    for i, turn in enumerate(np.radians(np.arange(0, 360, 20))):
        eye = 3.0 * np.array([np.cos(turn), np.sin(turn), 0.3 * np.sin(3 * turn)])
        camera = look_at(eye, np.zeros(3), np.array([0.0, 0, 1]), width=SIDE, height=SIDE, fx=1.25 * SIDE)
        views.append(View.from_arrays(f"{i:02d}.png", camera, ball_image(camera)))
    bounds = np.array([[-1.3, -1.3, -1.3], [1.3, 1.3, 1.3]])
    scene = Scene("ball", "blender", tuple(views), (), None, 3.3, bounds)
    recipe = get_recipe("best")
    trainer = Trainer(scene, scale_schedule(recipe, ITERATIONS / recipe.iterations), NERF_SYNTHETIC, backend="cpu")
    return scene, trainer.run(), trainer.settings


def gradients(
    library: Library, splats: Splats, view: View, settings: RasterSettings, given: dict[str, Tensor]
) -> dict[str, Tensor]:
    """Return the gradients [N, ...] float64 of the sum of images times what is given for each."""
    leaves = requiring_grad(splats.to(dtype=library.dtype))
    output = cpu.rasterize_with(library, leaves, view.camera, settings)
    images = [getattr(output, name) for name in given]
    found = torch.autograd.grad(
        images, [tensor for _, tensor in leaves.items()], [image.to(library.dtype) for image in given.values()]
    )
    return {name: gradient.double() for (name, _), gradient in zip(leaves.items(), found, strict=True)}


def test_gradients_are_those_of_float64_but_for_a_few_splats(
    native: Library, native64: Library, trained: tuple[Scene, Splats, RasterSettings]
) -> None:
    scene, splats, settings = trained
    settings = settings.for_depths("transmittance")
    far: dict[str, list[Tensor]] = {name: [] for name in ATTRIBUTES}
    for index in (0, 7):
        view = scene.train[index]
        color = cpu.rasterize_with(native64, splats.to(dtype=torch.float64), view.camera, settings).color
        photograph = torch.tensor(view.image()).double()[..., :3] / 255
        rng = torch.Generator().manual_seed(index)
        given = {
            "color": (color - photograph).sign() / color.numel(),  # as of the L1 loss
            "normal": torch.randn(*color.shape, generator=rng, dtype=torch.float64) * 0.05 / color.numel(),
            "depth_transmittance": torch.randn(*color.shape[:2], generator=rng, dtype=torch.float64) / color.numel(),
        }
        low = gradients(native, splats, view, settings, given)
        high = gradients(native64, splats, view, settings, given)
        for name in ATTRIBUTES:
            size = high[name].reshape(len(splats), -1).norm(dim=1)
            counts = size > 1e-3 * size.max()  # of the others rounding is all there is
            assert counts.sum() > 100, name
            far[name].append((low[name] - high[name]).reshape(len(splats), -1).norm(dim=1)[counts] / size[counts])
    for name, parts in far.items():
        errors = torch.cat(parts).numpy()
        assert np.median(errors) < 1e-4, (name, np.median(errors))
        assert np.quantile(errors, 0.99) < 5e-3, (name, np.quantile(errors, 0.99))
        assert (errors > 0.1).mean() < 2e-3, (name, (errors > 0.1).mean())
