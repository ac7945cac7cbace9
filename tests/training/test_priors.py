"""Training with depth and normal priors: reading, fitting relative maps, effect on depths, resuming."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from gs2d.config.presets import with_depth_prior, with_normal_prior
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import DepthPrior, LearningRates, Recipe
from gs2d.core.transforms import quats_to_matrices
from gs2d.data.prior_maps import MapFiles, ObservedPoints, PriorDepth
from gs2d.data.scene import Scene
from gs2d.errors import DataError
from gs2d.losses.prior_formulas import MetricDepth, PointDepths, RelativeDepths
from gs2d.losses.priors import metric_depths, plan_depths
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.training.start.initialize import initial_splats, turned_to
from gs2d.training.start.prior_points import plane_normals, with_prior_points
from gs2d.training.trainer import Trainer
from saved_states import resumed_everywhere
from train_toys import SIZE, random_splats, same, short


@dataclass(frozen=True)
class Maps:
    """In-memory maps with the interface of ``PriorMaps``."""

    values: np.ndarray
    files: MapFiles
    whole: bool = False

    def depth(self) -> PriorDepth:
        return PriorDepth(self.values.astype(np.float32), self.whole)

    def normal(self) -> np.ndarray:
        return self.values.astype(np.float32)


def mapped(
    scene: Scene, make: Callable[[int, np.ndarray], np.ndarray], *, whole: bool = False, **files: object
) -> Scene:
    """Add a depth map to each training view, computed from the depths of the scene's points."""
    truth, views = random_splats(80, seed=3), []
    for index, view in enumerate(scene.train):
        with torch.no_grad():
            depth = rasterize(truth, view.camera, RasterSettings(), backend="reference").depth_mean.numpy()
        maps = Maps(make(index, depth), MapFiles(depth="known", **files), whole)  # type: ignore[arg-type]
        views.append(replace(view, maps=maps))  # type: ignore[arg-type]
    return replace(scene, train=tuple(views))


def observed(scene: Scene, error: float = 0.5, track: int = 4) -> Scene:
    """Return the scene with all its points observed by every view."""
    assert scene.points is not None
    count = len(scene.points)
    seen = {view.name: np.arange(count) for view in scene.train}
    found = ObservedPoints(scene.points.points, np.full(count, error), np.full(count, track), seen)
    return replace(scene, observe=lambda: found)


@pytest.fixture(autouse=True)
def faint_pixels_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare depths of faint pixels too, because the initial splats leave most pixels faint."""
    monkeypatch.setattr("gs2d.losses.prior_formulas.OPACITY", 0.05)


# -- reading --------------------------------------------------------------------------------------------------------
def test_auto_prefers_sensor_maps_then_relative_maps_then_points(scene: Scene) -> None:
    def keep(_: int, depth: np.ndarray) -> np.ndarray:
        return depth

    both = observed(scene)
    assert plan_depths(both, DepthPrior()).source == "sparse"
    assert plan_depths(mapped(both, keep), DepthPrior()).source == "relative"
    assert plan_depths(mapped(both, keep, metric=True), DepthPrior()).source == "sensor"
    assert plan_depths(mapped(both, keep, metric=True), DepthPrior("sparse")).source == "sparse"


def test_a_capture_without_known_depths_is_refused(scene: Scene) -> None:
    with pytest.raises(DataError, match="sparse"):
        Trainer(scene, with_depth_prior(short()), GENERIC, backend="reference")
    with pytest.raises(DataError, match="training"):
        Trainer(scene, with_depth_prior(short(), "sensor"), GENERIC, backend="reference")
    with pytest.raises(DataError, match="training"):
        Trainer(scene, with_normal_prior(short()), GENERIC, backend="reference")


def test_point_depths_have_the_four_pixels_around_them(scene: Scene) -> None:
    both, view = observed(scene), scene.train[2]
    plan = plan_depths(both, DepthPrior())
    valid = metric_depths(view, plan, DepthPrior(), torch.float64)
    assert isinstance(valid, PointDepths)
    rows, columns = valid.pixels // SIZE, valid.pixels % SIZE
    x = (valid.weights * (columns + 0.5)).sum(dim=1).numpy()
    y = (valid.weights * (rows + 0.5)).sum(dim=1).numpy()
    assert scene.points is not None
    pixels, depth = view.camera.project(scene.points.points)
    places = {(round(a, 6), round(b, 6)): d for (a, b), d in zip(pixels.tolist(), depth.tolist(), strict=True)}
    for a, b, d in zip(x.tolist(), y.tolist(), valid.depth.tolist(), strict=True):
        assert places[(round(a, 6), round(b, 6))] == pytest.approx(d)


def test_the_unit_of_sensor_maps_is_fitted_to_the_points(scene: Scene) -> None:
    made = mapped(observed(scene), lambda _, depth: 700 * depth, whole=True, metric=True)
    assert plan_depths(made, DepthPrior()).unit == pytest.approx(1 / 700, rel=0.1)  # the points are noisy
    assert plan_depths(made, DepthPrior(unit=0.3)).unit == 0.3
    assert plan_depths(replace(made, observe=None), DepthPrior()).unit is None
    few = replace(made, train=made.train[:1])
    assert few.observe is not None
    two = replace(few.observe(), by_view={few.train[0].name: np.arange(2)})
    with pytest.raises(DataError, match="--set"):
        plan_depths(replace(few, observe=lambda: two), DepthPrior("sensor"))


@pytest.mark.parametrize("space", ["disparity", "depth"])
def test_relative_maps_are_fitted_to_the_points_in_the_better_space(scene: Scene, space: str) -> None:
    def make(index: int, depth: np.ndarray) -> np.ndarray:
        hit = depth > 0
        value = 1 / np.where(hit, depth, 1) if space == "disparity" else depth
        return np.where(hit, (50 + 30 * index) * value + 20 + index, 0)

    rng = np.random.default_rng(0)
    exact = mapped(scene, lambda _, depth: depth)
    views = {}
    rows, xyz = 0, []
    for view in exact.train:  # points exactly on the surface of each view's map
        depth = view.maps.values  # type: ignore[union-attr]
        y, x = np.nonzero(depth)
        chosen = rng.choice(len(x), 60, replace=False)
        x, y = x[chosen], y[chosen]
        c, z = view.camera, depth[y, x]
        local = np.stack([(x + 0.5 - c.cx) / c.fx * z, (y + 0.5 - c.cy) / c.fy * z, z], axis=1)
        xyz.append((local - c.T_cam_world[:3, 3]) @ c.rotation)
        views[view.name] = np.arange(rows, rows + 60)
        rows += 60
    found = ObservedPoints(np.concatenate(xyz), np.full(rows, 0.3), np.full(rows, 5), views)
    made = replace(mapped(scene, make), observe=lambda: found)
    settings = DepthPrior("relative")
    plan = plan_depths(made, settings)
    assert plan.space == space
    for view, true in zip(made.train, exact.train, strict=True):
        valid = metric_depths(view, plan, settings, torch.float64)
        assert isinstance(valid, MetricDepth)
        depth = torch.from_numpy(true.maps.values).double()  # type: ignore[union-attr]
        there = valid.valid
        assert (depth[there] * valid.disparity[there] - 1).abs().median() < 1e-4
    rendered = replace(settings, align="rendered")
    assert plan_depths(made, rendered).observed is None
    assert isinstance(metric_depths(made.train[0], plan_depths(made, rendered), rendered), RelativeDepths)


# -- normals --------------------------------------------------------------------------------------------------------
def facing(scene: Scene, flip: tuple[int, int, int]) -> Scene:
    """Return normals that point at the camera, in flipped axes."""
    towards = -np.array(flip) * np.array([0.0, 0.0, 1.0])
    views = [
        replace(view, maps=Maps(np.tile(towards, (SIZE, SIZE, 1)), MapFiles(normal="known")))  # type: ignore[arg-type]
        for view in scene.train
    ]
    return replace(scene, train=tuple(views))


# -- initialisation -------------------------------------------------------------------------------------------------
def test_training_starts_from_points_on_depth_maps(scene: Scene) -> None:
    made = mapped(scene, lambda _, depth: np.where(depth > 0, 3.0, 0))  # planes in front of the cameras
    recipe = replace(with_depth_prior(short(), "sensor"), init_points=120)
    cloud, own = with_prior_points(made, recipe).points, scene.points
    assert cloud is not None
    assert own is not None
    added = len(cloud) - len(own)
    assert 100 <= added <= 126
    assert (cloud.points[added:] == own.points).all()
    fraction = added // 6
    for k, view in enumerate(made.train):
        points, colors = (
            cloud.points[k * fraction : (k + 1) * fraction],
            cloud.colors[k * fraction : (k + 1) * fraction],
        )  # type: ignore[index]
        pixels, depth = view.camera.project(points)
        assert np.allclose(depth, 3.0)
        assert np.allclose(pixels % 1, 0.5)  # at pixel centres, with the pixel colours
        columns, rows = np.floor(pixels).astype(int).T
        assert (colors == view.image()[rows, columns]).all()
    again = with_prior_points(made, recipe).points
    assert again is not None
    assert (again.points == cloud.points).all()
    other = with_prior_points(made, replace(recipe, seed=1)).points
    assert other is not None
    assert (other.points[:9] != cloud.points[:9]).any()


def test_splats_on_depth_maps_are_tangential_to_the_surface(scene: Scene) -> None:
    made = mapped(replace(scene, train=scene.train[:1]), lambda _, depth: np.full_like(depth, 3.0))
    start = with_prior_points(replace(made, points=None), replace(with_depth_prior(short(), "sensor"), init_points=200))
    generator = torch.Generator().manual_seed(0)
    splats = initial_splats(start, sh_degree=0, random_points=5, near=0.1, generator=generator).splats
    normals = quats_to_matrices(splats.quats.double())[:, :, 2].numpy()
    assert np.allclose(np.abs(normals @ made.train[0].camera.forward), 1, atol=1e-5)
    assert (plane_normals(np.zeros((3, 3))) == 0).all()
    up = torch.tensor([[0.0, 0, -1], [0, 0, 0], [1, 0, 0]], dtype=torch.float64)
    others = torch.tensor([[0.0, 1, 0, 0]] * 3, dtype=torch.float64)
    turned = quats_to_matrices(turned_to(up, others))[:, :, 2].abs()
    assert torch.allclose(turned, torch.tensor([[0.0, 0, 1], [0, 0, 1], [1, 0, 0]], dtype=torch.float64))
    assert turned_to(up, others)[1].tolist() == [0, 1, 0, 0]


# -- training -------------------------------------------------------------------------------------------------------
def cases(scene: Scene) -> dict[str, tuple[Scene, Recipe]]:
    relative = mapped(scene, lambda _, depth: np.where(depth > 0, 3 / np.where(depth > 0, depth, 1) + 1, 0))
    return {
        "sparse": (observed(scene), with_depth_prior(short(), "sparse")),
        "sensor": (mapped(scene, lambda _, depth: depth), with_depth_prior(short(), "sensor")),
        "relative": (relative, with_depth_prior(short(), "relative")),
    }


@pytest.mark.parametrize("source", ["sparse", "sensor", "relative"])
def test_known_depths_move_means_and_no_colours(scene: Scene, backend: str, source: str) -> None:
    made, recipe = cases(scene)[source]
    trainer = Trainer(made, recipe, GENERIC, backend=backend)
    trainer.enter(0)
    stage = trainer.recipe.stages[0]
    with_it = trainer._whole.evaluate(trainer.state, stage, 1, 0)
    plain = replace(stage, losses=stage.losses[:-1])
    without = trainer._whole.evaluate(trainer.state, plain, 1, 0)
    assert set(with_it.losses) - set(without.losses) == {"depth_prior"}
    assert with_it.losses["depth_prior"] > 0
    assert not torch.equal(with_it.gradients["means"], without.gradients["means"])
    assert torch.equal(with_it.gradients["sh0"], without.gradients["sh0"])


def test_known_depths_improve_the_surface(scene: Scene) -> None:
    made, _ = cases(scene)["sensor"]
    first = short().stages[0]
    lr = LearningRates(means=5e-3, means_final=1e-3, means_decay_steps=40)
    plain = Recipe("plain", (replace(first, iterations=40, densify=None, losses=first.losses[:2], lr=lr),))

    def error(recipe: Recipe) -> float:
        trainer, found = Trainer(made, recipe, GENERIC, backend="auto"), []
        trainer.run()
        for view in made.train:
            with torch.no_grad():
                output = rasterize(trainer.splats, view.camera, trainer.settings, backend="auto")
            truth = torch.from_numpy(view.maps.values)  # type: ignore[union-attr]
            there = (truth > 0) & (output.alpha > 0.5)
            found.append(float((output.depth_mean / truth - 1).abs()[there].mean()))
        return float(np.mean(found))

    assert error(with_depth_prior(plain, "sensor", 2.0)) < 0.85 * error(plain)


@pytest.mark.parametrize("source", ["sparse", "relative"])
def test_a_resumed_training_gives_the_same_bytes(scene: Scene, backend: str, source: str) -> None:
    made, recipe = cases(scene)[source]
    end = resumed_everywhere(made, recipe, backend, every=12)
    assert not same(end, Trainer(scene, short(), GENERIC, backend=backend).run())


def test_normals_are_trained_by_maps(scene: Scene, backend: str) -> None:
    made = facing(scene, (1, -1, -1))
    trainer = Trainer(made, with_normal_prior(short()), GENERIC, backend=backend)
    trainer.enter(0)
    stage = trainer.recipe.stages[0]
    found = trainer._whole.evaluate(trainer.state, stage, 7_001, 0)
    assert found.losses["normal_prior"] > 0
