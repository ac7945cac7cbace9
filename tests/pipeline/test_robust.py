"""The choice of robust training, and predicted exposures of new views."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gs2d.config.presets import (
    with_robustness,
)
from gs2d.config.protocols import DTU, GENERIC, Protocol
from gs2d.config.recipe import LearningRates, Recipe, Removal
from gs2d.config.serialize import to_json
from gs2d.core.camera import look_at
from gs2d.data.prior_maps import ObservedPoints
from gs2d.data.scene import Scene, View
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.prepare.loaded import check_same_run, reload_run
from gs2d.pipeline.prepare.open_capture import OpenCapture
from gs2d.pipeline.prepare.options import Training
from gs2d.pipeline.prepare.predicted_views import with_predicted
from gs2d.pipeline.prepare.resolve import build_recipe, resolve, robust_and_exposure
from gs2d.render.backends import get_backend
from gs2d.training.events import Event, Notice, OnEvent
from gs2d.training.learned.predicted_exposure import predicted_exposures
from gs2d.training.learned.quantity import LearnedQuantity

COUNT = 12


def ring(gains: np.ndarray, test: int = 0) -> Scene:
    """Views on a ring around grey points, each of one grey that is 0.5 times its gain."""
    views = []
    for angle, gain in zip(np.linspace(0, 2 * np.pi, len(gains), endpoint=False), gains, strict=True):
        camera = look_at(
            3 * np.array([np.cos(angle), np.sin(angle), 0.0]), np.zeros(3), np.array([0.0, 0, 1]), width=16, height=16,
            fx=16.0,
        )  # fmt: skip
        image = np.full((16, 16, 3), round(127.5 * gain), np.uint8)
        views.append(View.from_arrays(f"{len(views):02d}", camera, image))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (80, 3))
    seen = {view.name: np.arange(80) for view in views}
    observed = ObservedPoints(points, np.full(80, 0.5), np.full(80, len(views)), seen)
    split = len(views) - test
    bounds = np.array([[-1.0] * 3, [1.0] * 3])
    return Scene(
        "ring", "colmap", tuple(views[:split]), tuple(views[split:]), None, 3.3, bounds, observe=lambda: observed
    )


def options(**changes: object) -> Training:
    return Training(**{"recipe": "2dgs", **changes})  # type: ignore[arg-type]


def fitted(training: Training, scene: Scene, protocol: Protocol, on_event: OnEvent) -> Recipe:
    """The recipe at a tenth of its schedule."""
    robust, exposure = robust_and_exposure(training, scene, protocol, on_event)
    return build_recipe(training, schedule_scale=0.1, robust=robust, exposure=exposure)


def resolved(training: Training, scene: Scene, on_event: OnEvent) -> tuple[Recipe, Protocol]:
    """The recipe and the protocol as they are trained."""
    capture = OpenCapture(scene, GENERIC, get_backend("reference"), 1)
    recipe, capture = resolve(training, capture, on_event, schedule_scale=0.1)
    return recipe, capture.protocol


EQUAL, VARIED = ring(np.ones(COUNT)), ring(1 + 0.2 * np.sin(np.arange(COUNT)))
BLIND = replace(EQUAL, observe=None)
LACKS = "the model must hold sparse points, got none"


def no_points() -> ObservedPoints:
    """As of a COLMAP model with an empty points3D.bin."""
    raise DataError(LACKS)


EMPTY = replace(EQUAL, observe=no_points)


@pytest.mark.parametrize(
    ("asked", "scene", "protocol", "robust", "exposure"),
    [
        ({}, EQUAL, GENERIC, True, False),
        ({}, VARIED, GENERIC, True, True),
        ({}, VARIED, DTU, False, False),
        ({}, BLIND, GENERIC, False, False),
        ({}, EMPTY, GENERIC, False, False),
        ({"robust": "off"}, VARIED, GENERIC, False, False),
        ({"robust": "on"}, VARIED, DTU, True, True),
        ({"learn": "none"}, VARIED, GENERIC, True, False),
        ({"learn": "exposure"}, EQUAL, GENERIC, True, True),
        ({"learn": "exposure", "robust": "off"}, EQUAL, GENERIC, False, True),
    ],
)
def test_training_is_robust_where_protocol_and_capture_allow_it(
    asked: dict[str, object], scene: Scene, protocol: object, robust: bool, exposure: bool
) -> None:
    recipe = fitted(options(**asked), scene, protocol, lambda _: None)  # type: ignore[arg-type]
    for part in (recipe.dense_start, recipe.removal):
        assert (part is not None) == robust
    assert recipe.learns("exposure") == exposure
    assert (recipe.stages[0].lr.sh0 > LearningRates().sh0) == robust  # a tenth of the schedule: longer steps


# -- predicted exposures ----------------------------------------------------------------
def predicted(gains: np.ndarray) -> float:
    """The gain that the last view of the ring would have, by those of the others."""
    scene = ring(gains, test=1)
    found = predicted_exposures(exposed(scene, gains))
    return float(found[scene.test[0].name][0, 0])


def exposed(scene: Scene, gains: np.ndarray) -> Scene:
    """Return the scene with these gains of its training views."""
    known = zip(scene.train, gains, strict=False)
    return scene.with_appearance({view.name: {"exposure": np.eye(3, 4) * gain} for view, gain in known})


def test_a_view_between_neighbours_with_similar_exposures_has_theirs() -> None:
    gains = 1 + 0.3 * np.cos(np.linspace(0, 2 * np.pi, 24, endpoint=False))
    assert predicted(gains) == pytest.approx(gains[-1], abs=0.05)


def by_meter(gains: np.ndarray, seen: np.ndarray) -> float:
    """The gain that the last view of the ring would have, where the scene is so bright in each view."""
    scene = ring(gains, test=1)
    brightness = {view.name: float(value) for view, value in zip(scene.views, seen, strict=True)}
    found = predicted_exposures(exposed(scene, gains), lambda view: brightness[view.name])
    return float(found[scene.test[0].name][0, 0])


def test_exposures_that_follow_brightness_are_predicted_from_it() -> None:
    seen = 0.4 + 0.2 * np.sin(1.7 * np.arange(24) ** 2)  # as if by chance: neighbours say nothing
    gains = (seen + 0.02) ** -0.8
    gains /= gains[:-1].mean()
    assert by_meter(gains, seen) == pytest.approx(gains[-1], rel=0.02)


def test_quantities_of_packages_are_predicted_as_exposures_are(monkeypatch: pytest.MonkeyPatch) -> None:
    class Haze(LearnedQuantity):
        @staticmethod
        def predicted(scene: Scene, brightness: Callable[[View], float] | None) -> dict[str, np.ndarray]:
            mean = np.mean([view.appearance["haze"] for view in scene.train], axis=0)
            return {view.name: mean for view in scene.test}

    monkeypatch.setattr("gs2d.pipeline.prepare.predicted_views.QUANTITIES", {"haze": Haze})
    scene = ring(np.ones(4), test=1)
    hazy = {view.name: {"haze": np.full(1, float(index))} for index, view in enumerate(scene.train)}
    shown = with_predicted(scene.with_appearance(hazy))
    assert shown.test[0].appearance["haze"] == pytest.approx(np.mean(range(len(scene.train))))


def test_another_removal_changes_stage_keys_and_runs(undisturbed: RunFolder, tmp_path: Path) -> None:
    run = RunFolder(Path(shutil.copytree(undisturbed.path, tmp_path / "run")))
    job = reload_run(run, lambda _: None)
    recipe = with_robustness(job.recipe)
    recipes = (recipe, replace(recipe, removal=None), replace(recipe, removal=Removal(dropout=0.3)))
    robust, none, more = (replace(job, resolved=replace(job.resolved, recipe=each)) for each in recipes)
    assert len({one.stage_key(0) for one in (robust, none, more)}) == 3
    data = json.loads(run.file("run.json").read_text())
    data["recipe"] = to_json(robust.recipe)
    run.file("run.json").write_text(json.dumps(data))
    with pytest.raises(RunError, match="another"):
        check_same_run(run, more.resolved)
    check_same_run(run, robust.resolved)


@pytest.mark.parametrize(("brightness", "proposed"), [(1.0, False), (0.1, True)])
def test_splats_of_an_unlit_backdrop_are_proposed_for_removal_but_not_those_of_a_white_floor(
    brightness: float, proposed: bool
) -> None:
    heard: list[Event] = []
    recipe, protocol = resolved(options(), ring(np.full(COUNT, brightness)), heard.append)
    assert recipe.removal is not None
    assert recipe.removal.backdrop == proposed
    assert protocol.background == pytest.approx((0.5 * brightness,) * 3, abs=0.02)
    assert any(isinstance(event, Notice) and event.text.startswith("background") for event in heard)
