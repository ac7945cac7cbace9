"""How splats multiply: densification that is tried, as often shown as in the whole capture, and what comes after."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.config.presets import get_recipe
from gs2d.config.recipe import GradDensify
from gs2d.core.camera import look_at
from gs2d.data.scene import View
from gs2d.pipeline.growth import NONE, densifications, extrapolated, moved_away, seen_fraction, shown_as_often
from train_toys import random_splats


def test_what_was_not_tried_grows_by_the_last_rates_over_the_number_of_the_densification() -> None:
    found = extrapolated([2.0, 4.0], 4)  # log 2 each; then 2/3 and 2/4 of it
    assert found is not None
    rest = math.log(2) * (2 / 3 + 2 / 4)
    assert found.expected == pytest.approx(4 * math.exp(rest))
    assert found.most / found.expected == pytest.approx(math.exp(0.25 * math.log(4) + 0.5 * rest))
    assert found.least * found.most == pytest.approx(found.expected**2)


def test_growth_that_was_tried_to_its_end_is_only_as_unsure_as_a_few_photographs_are() -> None:
    found = extrapolated([1.5, 2.0], 2)
    assert found is not None
    assert found.expected == pytest.approx(2.0)
    assert found.most == pytest.approx(2.0**1.25)


def test_what_shrank_goes_on_neither_shrinking_nor_growing() -> None:
    found = extrapolated([0.5, 0.25], 10)
    assert found is not None
    assert found.expected == pytest.approx(0.25)


def test_without_a_densification_there_is_nothing_to_go_by_and_without_any_nothing_grows() -> None:
    assert extrapolated([], 3) is None
    assert extrapolated([], 0) == NONE


def test_densifications_are_those_of_the_schedule() -> None:
    densify = GradDensify(start=500, stop=1000, every=100)
    assert densifications(densify) == 4  # 600, 700, 800, 900
    stage = replace(get_recipe("2dgs").stages[0], densify=densify)
    fewer = shown_as_often(stage, densify, 0.1).densify
    assert isinstance(fewer, GradDensify)
    assert (fewer.every, fewer.start) == (10, 50)
    assert densifications(fewer) >= 4
    assert fewer.max_splats is None


def test_a_splat_is_shown_by_the_photographs_that_look_at_it() -> None:
    splats = replace(random_splats(50), means=torch.zeros(50, 3))
    up, far = np.array([0.0, 0.0, 1.0]), np.array([9.0, 0.0, 0.0])
    cameras = [look_at(np.array([0.0, -3.0, 0.0]), aim, up, width=8, height=8, fx=8.0) for aim in (np.zeros(3), far)]
    views = [View.from_arrays(f"{i}", camera, np.zeros((8, 8, 3), np.uint8)) for i, camera in enumerate(cameras)]
    assert seen_fraction(splats, views) == 0.5
    assert seen_fraction(splats, views[1:]) == 1.0  # at least one shows it, somewhere
    both = moved_away(splats, 1e4)
    assert len(both) == 100
    assert float(both.means[50:].min()) == 1e4
