"""The recipes for users, and the choices that they brought."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gs2d.config.presets import (
    DEFAULT_RECIPE,
    NC_WITHOUT_SQUARES,
    OFFICIAL_ITERATIONS,
    RECIPES,
    SH_FASTER,
    get_recipe,
    with_few_views,
    with_robustness,
)
from gs2d.config.recipe import DenseStart, GradDensify, Removal
from gs2d.config.schedule import scale_schedule

NAMES = ("best", "best-fast")


def test_the_default_is_listed_first() -> None:
    assert list(RECIPES)[:2] == list(NAMES)
    assert DEFAULT_RECIPE == "best"


@pytest.mark.parametrize("name", NAMES)
def test_best_recipes_have_shorter_schedules_with_larger_rates(name: str) -> None:
    (stage,), (official,) = get_recipe(name).stages, get_recipe("2dgs").stages
    part = stage.iterations / OFFICIAL_ITERATIONS
    assert isinstance(stage.densify, GradDensify)
    assert isinstance(official.densify, GradDensify)
    assert stage.densify.stop == round(part * official.densify.stop)
    assert stage.sh_interval == round(part * official.sh_interval)
    assert stage.lr.sh0 == pytest.approx(official.lr.sh0 * part**-0.25)
    assert stage.lr.means_at(stage.iterations) == pytest.approx(official.lr.means_final * part**-0.25)
    # So a part of a part has the same rates as one schedule of that length.
    short = scale_schedule(get_recipe(name), 0.1).stages[0]
    assert short.lr.opacity_logits == pytest.approx(official.lr.opacity_logits * (0.1 * part) ** -0.25)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_rates_of_best_recipes_settle_at_the_end(name: str, scale: float) -> None:
    (stage,) = scale_schedule(get_recipe(name), scale).stages
    end = stage.iterations
    assert (stage.lr.settled_at(round(0.69 * end)), stage.lr.settled_at(end)) == (1.0, pytest.approx(0.1))
    assert stage.lr.means_at(end) == pytest.approx(stage.lr.means_final)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_view_dependent_colours_learn_faster_except_with_few_images(name: str, scale: float) -> None:
    recipe = with_robustness(scale_schedule(get_recipe(name), scale))
    (stage,), (slow,) = recipe.stages, with_few_views(recipe).stages
    assert stage.lr.shN == pytest.approx(SH_FASTER * stage.lr.sh0 / 20)
    assert slow.lr.shN == pytest.approx(stage.lr.sh0 / 20)
    assert replace(slow, lr=replace(slow.lr, shN=stage.lr.shN), losses=stage.losses) == stage
    weights = {term.kind: term.weight for term in stage.losses if term.kind != "l2"}
    weights["normal_consistency"] = NC_WITHOUT_SQUARES
    assert {term.kind: term.weight for term in slow.losses} == weights


def test_robust_training_has_its_own_start_and_no_prune_by_size() -> None:
    robust = with_robustness(get_recipe("best"))
    assert robust.dense_start == DenseStart(sphere=True, adjust=True)
    (stage,) = robust.stages
    assert isinstance(stage.densify, GradDensify)
    assert not any(stage.densify.culls_scale(i) for i in range(1, stage.iterations + 1))
    assert with_robustness(get_recipe("2dgs")).stages == get_recipe("2dgs").stages
    own = replace(get_recipe("2dgs"), dense_start=DenseStart(side=99), removal=Removal(every=20))
    assert with_robustness(own).dense_start == own.dense_start
    assert with_robustness(own).removal == own.removal
