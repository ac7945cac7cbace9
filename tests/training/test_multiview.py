"""Multi-view training: neighbours, sampling, and byte-identical resuming."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.config.multiview import MultiView
from gs2d.config.presets import with_multiview
from gs2d.config.protocols import GENERIC
from gs2d.core.camera import look_at
from gs2d.data.scene import Scene, View
from gs2d.errors import DataError
from gs2d.render.api import rasterize
from gs2d.training.neighbours import ImageFiles, draw_turn, find_neighbours
from gs2d.training.targets import Targets
from gs2d.training.trainer import Trainer
from saved_states import resumed_everywhere
from train_toys import WIDE, compared, same, short


def ring(angles: list[float], distance: float = 3.0) -> Scene:
    """Return cameras around the origin at these angles in degrees, without points."""
    views = []
    for k, a in enumerate(np.radians(angles)):
        eye, up = distance * np.array([np.cos(a), np.sin(a), 0.0]), np.array([0.0, 0.0, 1.0])
        camera = look_at(eye, np.zeros(3), up, width=20, height=20, fx=20.0)
        views.append(View.from_arrays(f"{k}", camera, np.zeros((20, 20, 3), np.uint8)))
    bounds = np.array([[-1.0] * 3, [1.0] * 3])
    return Scene("ring", "blender", train=tuple(views), test=(), points=None, extent=3.3, bounds=bounds)


# -- neighbours ---------------------------------------------------------------------------------------------------
def test_neighbours_are_the_nearest_views_within_the_angle_and_the_baselines() -> None:
    # From 0 degrees: 1 is too close (baseline 2 sin(0.5) = 0.017 of the distance), 60 has another viewing direction.
    settings = MultiView(neighbours=3, max_angle=45.0, min_baseline=0.05, max_baseline=1.0)
    found = find_neighbours(ring([0, 1, 30, 10, 60, 20]), settings)
    assert found[0] == (3, 5, 2)
    assert found[4] == (2, 5)  # 30 and 40 degrees away; 50 is too far
    assert find_neighbours(ring([0, 1, 30, 10, 60, 20]), replace(settings, neighbours=1))[0] == (3,)
    assert find_neighbours(ring([0, 1, 30, 10]), replace(settings, max_baseline=0.3))[0] == (3,)  # 30: 0.52


def test_a_scene_without_neighbours_is_refused_before_anything_is_trained(scene: Scene) -> None:
    with pytest.raises(DataError, match="has a neighbour"):  # six views, 60 degrees apart
        Trainer(scene, with_multiview(short()), GENERIC, backend="reference")


# -- sampling -----------------------------------------------------------------------------------------------------
def test_an_iteration_draws_from_the_seed_the_stage_and_the_iteration_alone() -> None:
    recipe, neighbours = compared(), (3, 5, 7)

    def drawn(seed: int, stage: int, iteration: int) -> tuple[int, torch.Tensor]:
        turn = draw_turn(replace(recipe, seed=seed), stage, iteration, neighbours, WIDE)
        assert turn is not None
        return turn.neighbour, turn.draws

    first, again = drawn(0, 0, 9), drawn(0, 0, 9)
    assert first[0] == again[0]
    assert torch.equal(first[1], again[1])
    for other in ((1, 0, 9), (0, 2, 9), (0, 0, 10)):
        assert not torch.equal(first[1], drawn(*other)[1]), other
    assert {drawn(0, 0, i)[0] for i in range(40)} == set(neighbours)
    assert draw_turn(recipe, 0, 9, (), WIDE) is None
    assert drawn(2**63 - 1, 2, 10**6)[1].shape == (WIDE.patches,)  # the largest possible seed


# -- images -------------------------------------------------------------------------------------------------------
def test_patches_with_masked_or_transparent_pixels_are_not_compared() -> None:
    rng = np.random.default_rng(0)
    camera = ring([0]).train[0].camera
    image = rng.integers(0, 255, (20, 20, 4), dtype=np.uint8)
    image[..., 3] = 255
    image[4, 6, 3] = 254
    mask = np.ones((20, 20), bool)
    mask[15, 12] = False
    view = View.from_arrays("0", camera, image, mask)
    target = Targets((view,), (1.0, 1.0, 1.0), use_masks=True)[0]
    settings = MultiView(radius=2)
    clear = ImageFiles((view,), settings).of(0, target).clear.numpy()
    expected = np.zeros((20, 20), bool)
    expected[2:-2, 2:-2] = True
    expected[2:7, 4:9] = False
    expected[13:18, 10:15] = False
    assert np.array_equal(clear, expected)


# -- training -----------------------------------------------------------------------------------------------------
def test_both_multiview_losses_change_depths_after_their_start(scene: Scene, backend: str) -> None:
    trainer = Trainer(scene, compared(), GENERIC, backend=backend)
    trainer.enter(0)
    whole, stage = trainer._whole, trainer.recipe.stages[0]
    before, after = (whole.evaluate(trainer.state, stage, iteration, 0) for iteration in (6, 7))
    assert set(after.losses) - set(before.losses) == {"multiview_photometric", "multiview_geometric"}
    assert after.losses["multiview_photometric"] > 0
    assert after.losses["multiview_geometric"] > 0
    # A lower resolution of the neighbour's depth gives nearly the same values from a quarter of the pixels.
    assert trainer.recipe.multiview is not None
    coarse = replace(trainer.recipe, multiview=replace(trainer.recipe.multiview, depth_downscale=2))
    small = Trainer(scene, coarse, GENERIC, backend=backend, state=trainer.state)._whole
    neighbour = small.neighbour_of(trainer.state, stage, 7, 0, trainer.state.splats)
    assert neighbour is not None
    assert neighbour.depth.shape == tuple(-(-n // 2) for n in neighbour.source.grey.shape)
    found = small.evaluate(trainer.state, stage, 7, 0).losses["multiview_photometric"]
    assert float(found) == pytest.approx(float(after.losses["multiview_photometric"]), rel=0.2)
    only = replace(stage, losses=tuple(t for t in stage.losses if not t.kind.startswith("multiview")))
    plain = whole.evaluate(trainer.state, only, 7, 0)
    assert not torch.equal(after.gradients["means"], plain.gradients["means"])
    assert torch.equal(after.gradients["sh0"], plain.gradients["sh0"])  # the losses do not affect colours


def test_a_resumed_training_gives_the_same_bytes(scene: Scene, backend: str) -> None:
    end = resumed_everywhere(scene, compared(), backend, every=12)
    assert not same(end, Trainer(scene, short(), GENERIC, backend=backend).run())


def test_the_depth_of_the_neighbour_uses_the_current_splats(scene: Scene) -> None:
    trainer = Trainer(scene, compared(), GENERIC, backend="reference")
    trainer.enter(0)
    neighbour = trainer._whole.neighbour_of(trainer.state, trainer.recipe.stages[0], 9, 0, trainer.splats)
    assert neighbour is not None
    with torch.no_grad():
        expected = rasterize(trainer.splats, neighbour.camera, trainer.settings, backend="reference").depth_mean
    assert torch.equal(neighbour.depth, expected)
    assert not neighbour.depth.requires_grad
