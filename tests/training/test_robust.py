"""Prevention of floaters: plane sweep depths, free space in the images, opacity decay."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from fake_backends import lacking
from gs2d.config.presets import appearance, two_dgs, with_robustness
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import DenseStart, Recipe, Removal
from gs2d.config.schedule import scale_schedule
from gs2d.core.camera import Camera
from gs2d.core.sh import rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.data.scene import PointCloud, View
from gs2d.errors import DataError
from gs2d.render.api import rasterize
from gs2d.render.backends import get_backend
from gs2d.render.reference_backend import PLAIN
from gs2d.render.types import RasterSettings
from gs2d.training import events
from gs2d.training.learned.point_gains import point_gains, spread
from gs2d.training.robust.backdrop import EVEN, find_backdrop
from gs2d.training.robust.free_space_maps import FreeSpaceMaps
from gs2d.training.robust.large_splats import LARGEST, LARGEST_ANYWHERE, largest_log_scales, votes_against_unseen
from gs2d.training.robust.robustness import Robustness
from gs2d.training.robust.trial import Witness, missed
from gs2d.training.start.initialize import initial_splats
from gs2d.training.start.plane_sweep import sweep_views
from gs2d.training.start.start_points import start_points
from gs2d.training.trainer import Trainer
from train_toys import full_state, make_scene, random_splats
from wall_scene import HEIGHT, WALL, WIDTH, wall

RASTER, BACKEND = RasterSettings(), get_backend("reference")
SMALL = DenseStart(side=48, min_angle=1.0)


@cache
def swept_wall() -> object:
    return sweep_views(wall(), SMALL)


def splat_at(*places: tuple[float, float, float], scale: float = 0.02) -> Splats:
    """Return splats at these positions that face the cameras."""
    splats = random_splats(len(places))
    splats.means[:] = torch.tensor(places)
    splats.quats[:] = torch.tensor([1.0, 0, 0, 0])  # t_u = x, t_v = y
    splats.log_scales[:] = float(np.log(scale))
    return splats


# -- the plane sweep ------------------------------------------------------------------------------------------------
def test_a_sweep_finds_the_depth_of_a_textured_wall_only() -> None:
    sweep = swept_wall()
    depth = sweep.depths[2][:, 20:]  # type: ignore[attr-defined]
    valid = depth > 0
    assert valid.mean() > 0.8
    assert np.median(np.abs(depth[valid] / WALL - 1)) < 0.02  # a quarter of a pixel
    bare = sweep.depths[2][4:-4, 2:6]  # type: ignore[attr-defined]
    assert (bare > 0).mean() < 0.1


def test_training_starts_on_the_wall_facing_the_cameras() -> None:
    cloud = start_points(wall(), swept_wall(), SMALL)  # type: ignore[arg-type]
    assert len(cloud) > 200
    assert (np.abs(cloud.points[:, 2] / WALL - 1) < 0.05).mean() > 0.97
    assert cloud.normals is not None
    turned = np.abs(cloud.normals).sum(axis=1) > 0
    assert np.median(np.abs(cloud.normals[turned][:, 2])) > 0.9


def test_sparse_points_far_from_swept_ones_keep_their_size() -> None:
    scene = wall()
    assert scene.points is not None
    alone = np.array([[0.0, 0.0, 9.0], [0.3, 0.0, 9.0], [0.0, 0.4, 9.0], [0.0, 0.0, 8.5]])
    more = replace(scene, points=PointCloud(np.concatenate([scene.points.points, alone])))
    assert start_points(more, swept_wall(), SMALL).sizes is None  # type: ignore[arg-type]
    cloud = start_points(more, swept_wall(), replace(SMALL, fit=True))  # type: ignore[arg-type]
    assert cloud.sizes is not None
    assert np.flatnonzero(cloud.sizes).tolist() == list(range(len(cloud) - 4, len(cloud)))
    assert cloud.sizes[-4] == pytest.approx(np.sqrt((0.3**2 + 0.4**2 + 0.5**2) / 3))
    generator = torch.Generator().manual_seed(0)
    first = initial_splats(
        replace(more, points=cloud), sh_degree=0, random_points=9, near=0.01, generator=generator, dtype=torch.float64
    )
    assert first.sized.tolist() == (cloud.sizes > 0).tolist()
    torch.testing.assert_close(first.splats.scales[-4:, 0], torch.from_numpy(cloud.sizes[-4:]))


def test_pixels_that_a_mask_leaves_out_have_no_depth() -> None:
    views = list(wall().train)
    mask = np.ones((HEIGHT, WIDTH), dtype=bool)
    mask[:, 28:34] = False
    views[2] = View.from_arrays(views[2].name, views[2].camera, views[2].image(), mask)
    sweep = sweep_views(replace(wall(), train=tuple(views)), SMALL)
    assert (sweep.depths[2][:, 28:34] == 0).all()
    assert (sweep.depths[2][:, 36:] > 0).any()


# -- free space -----------------------------------------------------------------------------------------------------
@pytest.fixture
def maps() -> FreeSpaceMaps:
    return FreeSpaceMaps(swept_wall())  # type: ignore[arg-type]


def test_only_splats_in_front_of_the_wall_are_in_free_space(maps: FreeSpaceMaps) -> None:
    splats = splat_at((0.5, 0, 2.0), (0.5, 0, 0.97 * WALL), (0.5, 0, WALL), (0.5, 0, 6.0), (0.5, 0, -2.0))
    assert (maps.against(splats) > 0).tolist() == [True, False, False, False, False]


def test_the_images_that_see_through_a_splat_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gs2d.training.robust.free_space_maps.BALL", 0.0)
    maps = FreeSpaceMaps(swept_wall())  # type: ignore[arg-type]
    all_of_them, some = maps.against(splat_at((0.2, 0.0, 2.0), (2.1, 0.0, 3.0))).tolist()
    assert all_of_them == len(wall().train)
    assert 0 < some < all_of_them


def test_a_surface_at_an_end_of_a_splat_counts(maps: FreeSpaceMaps) -> None:
    splats = splat_at((0.5, 0, WALL), (0.5, 0, 2.0), (0.5, 60.0, WALL), (0.5, 60.0, WALL))
    splats.log_scales[3, 1] = np.log(60.0)  # from outside of all images to the centre of the wall
    images = len(wall().train)
    assert maps.showing(splats).tolist() == [images, 0, 0, images]
    assert maps.showing(splats.rows(torch.tensor([], dtype=torch.int64))).tolist() == []


# -- removal trial --------------------------------------------------------------------------------------------------
def wall_of_splats() -> tuple[Splats, list[Witness]]:
    """Return a grid of grey splats on a wall of the same colour, five cameras, and their images."""
    x, y = torch.meshgrid(torch.linspace(-2, 2, 9), torch.linspace(-1.5, 1.5, 7), indexing="ij")
    places = [(float(a), float(b), WALL) for a, b in zip(x.flatten(), y.flatten(), strict=True)]
    splats = splat_at(*places, scale=0.35)
    splats.opacity_logits[:] = 4.0
    splats.sh0[:] = rgb_to_sh0(torch.tensor([[0.6, 0.5, 0.4]]))
    splats.shN[:] = 0
    witnesses = []
    for camera in cameras_of_the_wall():
        color = rasterize(splats, camera, RASTER, backend=BACKEND).color.detach()
        witnesses.append(Witness(camera, color, torch.ones(color.shape[:2], dtype=torch.bool)))
    return splats, witnesses


def with_fog(splats: Splats, place: tuple[float, float, float]) -> Splats:
    """Append a dark splat in front of a camera as the last row."""
    fog = splat_at(place, scale=0.1)
    fog.opacity_logits[:] = 2.0
    fog.sh0[:] = rgb_to_sh0(torch.tensor([[0.1, 0.1, 0.1]]))
    fog.shN[:] = 0
    return Splats(**{name: torch.cat([tensor, getattr(fog, name)]) for name, tensor in splats.items()})


def test_splats_that_the_images_miss_are_kept() -> None:
    """A mirror: one of five depth maps sees through the centre of the wall, but all five images show the wall."""
    splats, witnesses = wall_of_splats()
    middle = (splats.means[:, :2].norm(dim=1) < 0.6).to(torch.int32)
    assert missed(splats, middle, witnesses, RASTER, BACKEND).tolist() == (middle > 0).tolist()
    assert not missed(splats, 0 * middle, witnesses, RASTER, BACKEND).any()


def test_floaters_that_overfit_one_image_are_removed() -> None:
    splats, witnesses = wall_of_splats()
    place = tuple(witnesses[0].camera.center + np.array([0.0, 0.0, 1.0]))
    foggy = with_fog(splats, place)  # type: ignore[arg-type]
    color = rasterize(foggy, witnesses[0].camera, RASTER, backend=BACKEND).color.detach()
    assert not torch.allclose(color, witnesses[0].color, atol=0.1)
    learned = [replace(witnesses[0], color=color), *witnesses[1:]]  # only that image shows the floater
    against = torch.zeros(len(foggy), dtype=torch.int32)
    against[-1] = 1
    assert not missed(foggy, against, learned, RASTER, BACKEND).any()


# -- in training ----------------------------------------------------------------------------------------------------
def short(**changes: object) -> Recipe:
    made = scale_schedule(with_robustness(two_dgs()), 0.0005)  # 15 iterations
    stage = replace(made.stages[0], densify=None)
    made = replace(made, stages=(stage,), sh_degree=1, removal=Removal(every=10), dense_start=SMALL)
    return replace(made, **changes)  # type: ignore[arg-type]


def test_removed_floaters_are_reported_as_events() -> None:
    happened: list[object] = []
    trainer = Trainer(wall(), short(), GENERIC, backend="auto", on_event=happened.append)
    trainer.enter(0)
    assert isinstance(happened[0], events.Initialised)
    assert happened[0].source == "sweep"
    trainer.step()
    trainer.step()
    trainer.state.splats.means[:7] = torch.tensor([0.5, 0.0, 1.8])
    trainer.state.splats.sh0[:7] = -3.0  # black
    before = len(trainer.splats)
    trainer.step()  # the iteration at one fifth of the 15
    (removed,) = [event for event in happened if isinstance(event, events.FloatersRemoved)]
    assert removed.iteration == 3
    assert removed.removed >= 7
    assert len(trainer.splats) == removed.splats == before - removed.removed
    assert not ((trainer.splats.means - torch.tensor([0.5, 0.0, 1.8])).norm(dim=1) < 0.1).any()


@pytest.mark.parametrize("behind", [True, False])
def test_trials_render_frozen_splats(behind: bool) -> None:
    """Removing a dark floater makes images worse over black, but not if the frozen wall behind it is rendered."""
    frozen = wall_of_splats()[0] if behind else None
    state = full_state(20)
    splats = state.splats
    splats.means[:] = torch.tensor([0.5, 0.0, WALL])  # no depth map contradicts these
    splats.means[:5] = torch.tensor([0.5, 0.0, 1.8])
    splats.quats[:] = torch.tensor([1.0, 0, 0, 0])
    splats.log_scales[:] = float(np.log(0.1))
    splats.opacity_logits[:], splats.opacity_logits[:5] = -8.0, 1.0
    splats.sh0[:], splats.shN[:] = rgb_to_sh0(torch.tensor([[0.15, 0.15, 0.15]])), 0
    robust = Robustness(wall(), short(), RASTER, BACKEND, frozen=frozen)
    robust.remove(state, short().stages[0], 10)
    assert len(state.splats) == (15 if behind else 20)


def test_the_largest_scale_is_a_fraction_of_the_image_at_the_nearest_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = cameras_of_the_wall()
    splats = splat_at((0.5, 0, WALL), (0.2, 0.1, 2.0), (0.0, 0.0, 50.0))
    distance = torch.stack([(splats.means - torch.as_tensor(c.center).float()).norm(dim=1) for c in cameras]).amin(
        dim=0
    )
    angle = min(min(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras)
    expected = LARGEST * angle * distance
    whole = largest_log_scales(splats, cameras)
    torch.testing.assert_close(whole.exp().squeeze(1), expected)
    monkeypatch.setattr("gs2d.training.robust.large_splats.PAIRS", len(cameras))  # one splat at a time
    assert torch.equal(largest_log_scales(splats, cameras), whole)


def test_large_splats_shrink_on_known_surfaces_and_elsewhere_to_the_size_of_an_image() -> None:
    state, stage = full_state(20), short().stages[0]
    splats = state.splats
    splats.means[:10], splats.means[10:] = torch.tensor([0.5, 0.0, WALL]), torch.tensor([0.5, 0.0, 3 * WALL])
    splats.quats[:] = torch.tensor([1.0, 0, 0, 0])
    splats.log_scales[:] = torch.tensor([0.1, WALL]).log()
    robust = Robustness(wall(), short(), RASTER, BACKEND)
    kept = splats.log_scales.clone()
    robust.remove(state, replace(stage, iterations=10), 10)  # too late to train after shrinking
    robust.remove(state, replace(stage, iterations=100), 10)  # early: from coarse to fine
    assert torch.equal(state.splats.log_scales, kept[: len(state.splats)])
    robust.remove(state, replace(stage, iterations=20), 10)
    short_axis, long_axis = state.splats.scales[:10].T
    torch.testing.assert_close(short_axis, torch.full((10,), 0.1))
    assert (long_axis < 0.3 * WALL).all()
    assert torch.equal(state.splats.log_scales[10:], kept[10:])
    state.splats.log_scales[10:, 1] = math.log(100 * WALL)
    robust.remove(state, replace(stage, iterations=20), 10)
    most = largest_log_scales(state.splats, cameras_of_the_wall()) + math.log(LARGEST_ANYWHERE / LARGEST)
    torch.testing.assert_close(state.splats.log_scales[10:, 1:], most[10:])


def test_a_capture_without_observations_is_refused_in_one_line() -> None:
    with pytest.raises(DataError, match="ball must have sparse points .* train with --robust off"):
        Trainer(make_scene(), short(), GENERIC, backend="auto")


# -- visible fraction of a splat --------------------------------------------------------------------------------------
def walls_of(*rows: tuple[float, float, float, float, float]) -> Splats:
    """Return opaque splats that face the cameras; each row has x, z, two scales and opacity."""
    splats = splat_at(*((x, 0.0, z) for x, z, *_ in rows))
    splats.log_scales[:] = torch.tensor([[u, v] for *_, u, v, _ in rows]).log()
    splats.opacity_logits[:] = torch.logit(torch.tensor([row[4] for row in rows]))
    return splats


def cameras_of_the_wall() -> list[Camera]:
    return [view.camera for view in wall().train]


def test_large_splats_that_are_barely_visible_are_detected() -> None:
    beside = (9.0, WALL, 0.8, 0.8, 0.99)  # all images end before x = 3.2
    behind = (0.2, 2 * WALL, 1.0, 1.0, 0.99)
    before = (0.2, WALL, 4.0, 4.0, 0.99)
    near = (-1.5, 0.5, 0.3, 0.3, 0.99)
    splats, cameras = walls_of(before, beside, behind, near), cameras_of_the_wall()
    votes = votes_against_unseen(splats, cameras, RASTER, BACKEND)
    assert votes.tolist() == [0, 1, 0, len(cameras)]  # a splat occludes nothing that is in front of it


def test_barely_visible_splats_are_proposed_at_the_end_of_each_fifth() -> None:
    recipe = short(dense_start=SMALL)
    robust, stage = Robustness(wall(), recipe, RASTER, BACKEND), recipe.stages[0]
    due = [n for n in range(1, stage.iterations + 1) if robust.removes(stage, n)]
    assert due == [3, 6, 9, 10, 12, 15]
    state = full_state(2)
    for (_, mine), (_, made) in zip(state.splats.items(), walls_of((0, WALL, 1, 1, 0.9), (9, WALL, 3, 3, 0.9)).items(),
                                    strict=True):  # fmt: skip
        mine.copy_(made[:, : mine.shape[1]] if mine.dim() > 1 else made)
    state.splats.sh0[1] = -3.0  # as black as the background
    assert robust.remove(state, stage, 4) == []
    assert robust.remove(state, stage, 6) == [events.FloatersRemoved(stage.name, 6, 1, 1)]
    assert state.splats.means[0, 0] == 0
    assert not any(robust.removes(appearance(), n) for n in range(1, 20))


# -- opacity decay --------------------------------------------------------------------------------------------------
def test_opacity_decays_by_its_rate_every_ten_iterations_and_not_below_the_least() -> None:
    recipe = short(dense_start=None, removal=Removal(decay=0.1))
    robust, state = Robustness(wall(), recipe, RASTER, BACKEND), full_state(4)
    state.splats.opacity_logits[:] = torch.logit(torch.tensor([0.9, 0.5, 0.0051, 0.001]))
    state.splats.sh0[:] = 1.0  # different from the background colour
    robust.decay(state, recipe.stages[0], 9, PLAIN)
    assert state.splats.opacities == pytest.approx(torch.tensor([0.9, 0.5, 0.0051, 0.001]), abs=1e-6)
    robust.decay(state, recipe.stages[0], 10, lacking(1))
    assert state.splats.opacities == pytest.approx(torch.tensor([0.9, 0.5, 0.0051, 0.001]), abs=1e-6)
    robust.decay(state, recipe.stages[0], 10, lacking(0))
    assert state.splats.opacities == pytest.approx(torch.tensor([0.81, 0.45, 0.005, 0.001]), abs=1e-6)


def test_splats_in_the_colour_of_the_background_do_not_decay() -> None:
    """No image would raise their opacity again: a white floor before a white background would become transparent."""
    recipe = short(dense_start=None, removal=Removal(decay=0.1))
    raster = RasterSettings(background=(0.2, 0.6, 1.0))
    robust, state = Robustness(wall(), recipe, raster, BACKEND), full_state(3)
    state.splats.opacity_logits[:] = torch.logit(torch.tensor([0.8]))
    colours = [[0.2, 0.6, 1.0], [0.25, 0.55, 1.05], [0.2, 0.6, 1.07]]  # 1.07 is too far in one channel
    state.splats.sh0[:] = rgb_to_sh0(torch.tensor(colours))
    robust.decay(state, recipe.stages[0], 10, PLAIN)
    assert state.splats.opacities == pytest.approx(torch.tensor([0.8, 0.8, 0.72]), abs=1e-6)


# -- exposures from points ------------------------------------------------------------------------------------------
def test_gains_follow_from_the_colours_of_points() -> None:
    gains = (0.7, 0.85, 1.0, 0.9, 0.8)
    found = point_gains(wall(gains))
    assert found is not None
    expected = np.array(gains) / np.exp(np.mean(np.log(gains)))
    assert found == pytest.approx(np.repeat(expected[:, None], 3, axis=1), rel=0.03)
    assert spread(found) == pytest.approx(np.log(gains).std(), rel=0.1)
    same = point_gains(wall())
    assert same is not None
    assert spread(same) < 0.01


# -- background colour ------------------------------------------------------------------------------------------------
def test_the_backdrop_is_the_colour_of_pixels_without_sparse_points() -> None:
    found = find_backdrop(wall())
    assert found is not None
    assert found.color == pytest.approx((0.5, 0.5, 0.5), abs=0.02)


@pytest.mark.parametrize(("base", "most", "unlit"), [(0, 0, True), (0, 200, False), (60, 0, False)])
def test_an_unlit_backdrop_is_dark_and_even(base: int, most: int, unlit: bool) -> None:
    shades = (base + np.linspace(0, most, HEIGHT)).astype(np.uint8)[:, None, None]
    views = [View.from_arrays(view.name, view.camera, view.image() // 16 + shades) for view in wall().train]
    found = find_backdrop(replace(wall(), train=tuple(views)))
    assert found is not None
    assert found.is_unlit == unlit
    assert (found.alike > 0.9) if most == 0 else (found.alike < EVEN / 2)
