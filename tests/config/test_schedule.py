"""Scaled schedules: what shrinks, what does not."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from gs2d.config.presets import RECIPES, get_recipe, with_poses
from gs2d.config.recipe import ALL, GradDensify, LearningRates, validate
from gs2d.config.schedule import count_densifications, fit_schedule, longer_steps, scale_schedule
from gs2d.errors import RecipeError


def test_scaling_changes_lengths_starts_sh_interval_and_decay() -> None:
    surface, appearance, refine = scale_schedule(get_recipe("2dgs-r"), 0.1).stages
    assert [s.iterations for s in (surface, appearance, refine)] == [3000, 1000, 2000]
    assert [term.start for term in surface.losses] == [0, 0, 700]
    assert surface.sh_interval == 100
    assert surface.lr.means_decay_steps == 3000
    assert surface.lr.means_at(surface.iterations) == pytest.approx(1.6e-6)
    densify = surface.densify
    assert densify is not None
    # 100, 200, ..., 1400: fourteen fit, so the interval stays
    assert (densify.start, densify.stop, densify.every) == (50, 1500, 100)


@pytest.mark.parametrize(("factor", "start", "stop", "every"), [(0.03, 15, 450, 44), (0.01, 5, 150, 14)])
def test_the_interval_shrinks_until_ten_densifications_fit(factor: float, start: int, stop: int, every: int) -> None:
    densify = scale_schedule(get_recipe("2dgs"), factor).stages[0].densify
    assert densify is not None
    # 44, 88, ..., 440 are ten below 450 (45 * 10 = 450 is not); 14, ..., 140 are ten below 150 (15 * 10 = 150 is not)
    assert (densify.start, densify.stop, densify.every) == (start, stop, every)
    assert count_densifications(densify) == 10
    assert count_densifications(densify) == sum(densify.densifies(i) for i in range(1, stop))


def test_resets_keep_their_interval_get_a_grace_and_leave_200_iterations() -> None:
    densify = scale_schedule(get_recipe("2dgs"), 0.5).stages[0].densify
    assert densify is not None
    assert (densify.reset_every, densify.prune_grace, densify.last_reset) == (3000, 100, 7300)
    assert [i for i in range(1, 7500) if densify.resets(i, white=False)] == [3000, 6000]
    # 0.41: densification stops at 6150, and the reset at 6000 would leave 150
    late = scale_schedule(get_recipe("2dgs"), 0.41).stages[0].densify
    assert late is not None
    assert [i for i in range(1, late.stop) if late.resets(i, white=False)] == [3000]


def test_a_late_reset_on_white_is_dropped() -> None:
    def resets(factor: float) -> list[int]:
        densify = scale_schedule(get_recipe("2dgs"), factor).stages[0].densify
        assert densify is not None
        return [i for i in range(1, densify.stop) if densify.resets(i, white=True)]

    assert resets(0.03) == [15]  # 15 + 200 <= 450
    assert resets(0.01) == []  # 5 + 200 > 150


def test_the_start_of_the_prune_by_size_goes_with_the_schedule() -> None:
    recipe = get_recipe("2dgs")
    given = GradDensify(scale_cull_start=3_000, reset_every=0)
    (stage,) = scale_schedule(replace(recipe, stages=(replace(recipe.stages[0], densify=given),)), 0.1).stages
    assert isinstance(stage.densify, GradDensify)
    assert stage.densify.scale_cull_start == 300


def test_stretch_scales_rates_in_shorter_schedules() -> None:
    recipe = get_recipe("2dgs")
    stage = replace(recipe.stages[0], lr=LearningRates(stretch=0.25))
    stretched = replace(recipe, stages=(stage,))
    (short,) = scale_schedule(stretched, 1 / 16).stages
    (plain,) = scale_schedule(recipe, 1 / 16).stages
    for name in (*ALL, "means_final"):
        assert getattr(short.lr, name) == pytest.approx(2 * getattr(plain.lr, name))
    assert (short.lr.means_decay_steps, short.lr.beta1) == (plain.lr.means_decay_steps, plain.lr.beta1)
    (longer,) = scale_schedule(stretched, 2.0).stages
    assert longer.lr == replace(stage.lr, means_decay_steps=60_000)


@pytest.mark.parametrize("name", RECIPES)
@pytest.mark.parametrize("factor", [0.1, 0.03, 0.01, 1e-4])
def test_every_scaled_recipe_is_valid(name: str, factor: float) -> None:
    from gs2d.config.recipe import validate

    recipe = get_recipe(name)
    short = validate(scale_schedule(recipe, factor))
    for before, after in zip(recipe.stages, short.stages, strict=True):
        assert after.iterations == max(1, round(before.iterations * factor))
        assert after.train == before.train
        assert after.on_enter == before.on_enter


@pytest.mark.parametrize("factor", [0.0, -1.0, math.nan, math.inf, 1e9])
def test_a_factor_must_be_positive_and_finite(factor: float) -> None:
    with pytest.raises(RecipeError, match="--schedule-scale must be"):
        scale_schedule(get_recipe("2dgs"), factor)


def test_rates_of_poses_grow_in_shorter_schedules() -> None:
    facts = {
        factor: scale_schedule(with_poses(get_recipe("2dgs")), factor).quantities["poses"]
        for factor in (1.0, 0.25, 0.01)
    }
    assert {f: (p.decay_steps, p.start) for f, p in facts.items()} == {
        1.0: (30_000, 500),
        0.25: (7_500, 200),
        0.01: (300, 50),
    }
    for factor, poses in facts.items():
        assert poses.rate * math.sqrt(factor) == pytest.approx(5e-4)
        assert poses.rate_final / poses.rate == pytest.approx(0.01)
    assert poses.rate_at(50) == 0 < poses.rate_at(51)


def test_longer_steps_changes_only_rates() -> None:
    recipe = get_recipe("2dgs-r")
    assert longer_steps(recipe, 1.0) is recipe
    assert longer_steps(recipe, 4.0) is recipe
    for stage, before in zip(longer_steps(recipe, 1 / 16).stages, recipe.stages, strict=True):
        longer = {name: 2 * getattr(before.lr, name) for name in (*ALL, "means_final")}
        assert stage == replace(before, lr=replace(before.lr, **longer))


@pytest.mark.parametrize("name", ["2dgs", "2dgs-r", "2dgs-60k"])
@pytest.mark.parametrize("total", [3, 41, 1001, 77_777])
def test_a_schedule_fits_its_total_exactly(name: str, total: int) -> None:
    recipe = get_recipe(name)
    fitted = validate(fit_schedule(recipe, total))
    assert fitted.iterations == total
    for before, after in zip(recipe.stages, fitted.stages, strict=True):
        assert abs(after.iterations - max(1, before.iterations * total / recipe.iterations)) <= 1
    assert fit_schedule(recipe, recipe.iterations) is recipe
    assert fit_schedule(recipe, 3000 * len(recipe.stages)).stages[0].densify != recipe.stages[0].densify


@pytest.mark.parametrize("total", [2, 0, -5, 6_000_001, 100.0, True])
def test_too_few_or_too_many_iterations_are_refused(total: int) -> None:
    with pytest.raises(RecipeError, match="iterations"):
        fit_schedule(get_recipe("2dgs-r"), total)
