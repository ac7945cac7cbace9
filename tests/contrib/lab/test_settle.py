"""How many blocks memory needs, and whether a capture is what it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gs2d.config.presets import get_recipe
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import LearningRates
from gs2d.contrib.lab import settle as module
from gs2d.contrib.lab.partition import Partition
from gs2d.contrib.lab.settle import capture_digest, fitting_partition, over_again
from gs2d.errors import DataError
from gs2d.pipeline.prepare.estimate import Estimate, Range
from gs2d.pipeline.prepare.loaded import loaded_run
from gs2d.pipeline.prepare.open_capture import OpenCapture
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.render.backends import get_backend
from gs2d.training.events import Event
from train_toys import backends, make_scene

SCENE = make_scene()
OPTIONS = TrainOptions(scene=Path("capture"), out=Path("job"))
CAPTURE = OpenCapture(SCENE, GENERIC, get_backend(backends()[-1]), downscale=1)
SETTLED = loaded_run(OPTIONS, get_recipe("best"), CAPTURE, "digest", schedule_scale=1.0)
PLAN = Estimate(start=1_000_000, max_splats=None, memory=Range(1, 2, 3), seconds=Range(1, 2, 3))


def fitting(monkeypatch: pytest.MonkeyPatch, plan: Estimate | DataError, partition: Partition) -> Partition | None:
    def planned(*_: object, **__: object) -> Estimate:
        if isinstance(plan, DataError):
            raise plan
        return plan

    monkeypatch.setattr(module, "estimate", planned)
    return fitting_partition(SETTLED, OPTIONS, partition, lambda event: TOLD.append(event))


TOLD: list[Event] = []


def test_there_are_as_many_blocks_as_memory_needs_with_the_coarse_model_beside_each(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """4 million splats are expected, times (1 + 2 x 0.25)^2 for the margin: 9; 1.5 fit beside 0.75 of the coarse."""
    found = fitting(monkeypatch, replace(PLAN, max_splats=2_250_000), Partition(margin=0.25))
    assert found is not None
    assert found.coarse.max_splats == 750_000  # a third
    assert found.splats == 1_500_000
    assert found.blocks >= 6
    assert found.blocks - min(found.grid) < 6  # not a row more than that takes


def test_a_capture_is_known_by_its_cameras_points_and_split() -> None:
    one = capture_digest(SCENE)
    assert capture_digest(make_scene()) == one
    first = SCENE.train[0]
    turned = first.camera.T_cam_world.copy()
    turned[0, 3] += 1e-9
    assert capture_digest(replace(SCENE, train=(first.at(turned), *SCENE.train[1:]))) != one
    assert capture_digest(replace(SCENE, train=SCENE.train[1:], test=SCENE.train[:1])) != one
    assert SCENE.points is not None
    assert capture_digest(replace(SCENE, points=None)) != one


def test_rates_over_again_repeat_the_decay() -> None:
    rates = LearningRates(means_decay_steps=100, settle_start=60, settle_steps=40, settle_factor=0.1)
    again = over_again(rates, 80, 100, 50)
    for step in (0, 5, 20):
        assert again.means_at(round(2.5 * step)) == pytest.approx(rates.means_at(80 + step), rel=0.03)
    for now, before in ((0, 80), (25, 90), (50, 100)):
        assert again.quats * again.settled_at(now) == pytest.approx(rates.quats * rates.settled_at(before))
