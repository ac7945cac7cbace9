"""Recipes: rates, schedules of densification, and what validate() refuses."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gs2d.config.actions import CLONE_IN_PLACE, RANK_BY_ERROR
from gs2d.config.densify import Densify
from gs2d.config.quantities import EXPOSURE, POSES
from gs2d.config.recipe import (
    ALPHA,
    DepthPrior,
    GradDensify,
    LearningRates,
    LossTerm,
    NormalPrior,
    Recipe,
    Stage,
    validate,
)
from gs2d.config.serialize import apply_overrides, from_json, to_json
from gs2d.errors import RecipeError

L1 = (LossTerm("l1", 1.0),)


def one(**fields: object) -> Recipe:
    """A recipe of one stage "s" that is valid but for ``fields``."""
    return Recipe("r", (replace(Stage("s", 10, losses=L1), **fields),))  # type: ignore[arg-type]


def test_the_rate_of_the_means_is_log_linear_and_stays_at_its_end() -> None:
    lr = LearningRates(means=1e-4, means_final=1e-6, means_decay_steps=100)
    assert lr.means_at(0) == pytest.approx(1e-4)
    assert lr.means_at(50) == pytest.approx(1e-5)  # geometric mean
    assert lr.means_at(100) == pytest.approx(1e-6)
    assert lr.means_at(5000) == pytest.approx(1e-6)


def test_rates_at_the_end_are_constant() -> None:
    assert LearningRates().at_end(30_000) == replace(LearningRates(), means=1.6e-6, means_final=1.6e-6)
    half = LearningRates(means=1e-4, means_final=1e-6, means_decay_steps=100).at_end(50)
    assert half.means == half.means_final == pytest.approx(1e-5)
    assert half.means_at(1) == pytest.approx(1e-5)
    settling = LearningRates(settle_start=10, settle_steps=10, settle_factor=0.1).at_end(20)
    assert settling.settled_at(1) == settling.settled_at(20) == 1.0
    assert settling.sh0 == pytest.approx(0.1 * LearningRates().sh0)


def test_official_densification_runs_at_600_to_14900_every_100() -> None:
    iterations = [i for i in range(1, 30_001) if GradDensify().densifies(i)]
    assert iterations == list(range(600, 15_000, 100))
    assert len(iterations) == 144


def test_official_resets_are_every_3000_before_15000_and_at_500_on_white() -> None:
    densify = GradDensify()
    assert [i for i in range(1, 30_001) if densify.resets(i, white=False)] == [3000, 6000, 9000, 12000]
    assert [i for i in range(1, 30_001) if densify.resets(i, white=True)] == [500, 3000, 6000, 9000, 12000]


def test_last_reset_ends_resets() -> None:
    densify = GradDensify(last_reset=6000)
    assert [i for i in range(1, 15_000) if densify.resets(i, white=False)] == [3000, 6000]


def test_faint_splats_are_spared_for_exactly_the_grace_after_a_reset() -> None:
    densify = GradDensify(prune_grace=100)
    spared = [i for i in range(2900, 3200) if densify.in_prune_grace(i, white=False)]
    assert spared == list(range(3001, 3101))
    assert not GradDensify().in_prune_grace(3001, white=False)


def test_the_sh_degree_rises_every_interval_up_to_the_most() -> None:
    stage = Stage("s", 5000, sh_interval=1000)
    assert [stage.active_sh_degree(i, 3) for i in (1, 999, 1000, 2000, 3000, 4999)] == [0, 0, 1, 2, 3, 3]
    assert Stage("s", 10).active_sh_degree(1, 3) == 3
    assert stage.active_sh_degree(4000, 1) == 1


@pytest.mark.parametrize(
    ("recipe", "message"),
    [
        (Recipe("r", ()), "at least one stage"),
        (Recipe("r", (Stage("s", 1, losses=L1), Stage("s", 1, losses=L1))), "two stages are called 's'"),
        (replace(one(), seed=-1), "seed"),
        (replace(one(), sh_degree=4), "sh_degree"),
        (replace(one(), init_points=2**31), "init_points"),
        (one(iterations=-1), "iterations"),
        (one(losses=()), "no loss is active"),
        (one(losses=(LossTerm("l1", 1.0, start=5),)), "no loss is active"),
        (one(losses=(LossTerm("l1", -1.0),)), "weight of loss 'l1'"),
        (one(losses=(LossTerm("l1", float("nan")),)), "weight of loss 'l1'"),
        (one(losses=(*L1, *L1)), "there twice"),
        (one(losses=(*L1, LossTerm("ssim", 1.0, depth="max"))), "depth"),
        (one(train={"opacity": "all"}), "quats"),
        (one(train={}), "names no attribute"),
        (one(train={"sh0": "high_error"}), "high_error"),
        (one(on_enter=(CLONE_IN_PLACE,)), "high_error"),
        (one(on_enter=(RANK_BY_ERROR, CLONE_IN_PLACE.with_options(rows="clones"))), "high_error"),
        (one(on_enter=(RANK_BY_ERROR.with_options(writes="all"),)), "cannot be called 'all'"),
        (one(on_enter=(RANK_BY_ERROR.with_options(writes=3),)), "cannot be called 3"),
        (one(moments="old"), "moments"),
        (one(lr=LearningRates(sh0=-1.0)), "lr.sh0"),
        (one(lr=LearningRates(means=0.0)), "must be positive"),
        (one(lr=LearningRates(beta2=1.0)), "lr.beta2"),
        (one(lr=LearningRates(means_decay_steps=0)), "lr.means_decay_steps"),
        (one(densify=GradDensify(every=0)), "densify.every"),
        (one(densify=GradDensify(max_splats=0)), "max_splats"),
        (one(densify=GradDensify(scale_cull_start=-1)), "densify.scale_cull_start"),
        (one(densify=GradDensify(), train={"means": "all"}), "resets or caps opacity"),
    ],
)
def test_validate_names_the_stage_and_the_field(recipe: Recipe, message: str) -> None:
    with pytest.raises(RecipeError) as caught:
        validate(recipe)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


MOVING = replace(one(), stages=(Stage("s", 1, train={"means": "all"}, losses=L1),))
WHOLE = {  # valid recipes with the part that is changed
    "depth_prior": replace(one(losses=(*L1, LossTerm("depth_prior", 0.1))), depth_prior=DepthPrior()),
}


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("depth_prior.source", "lidar"),
        ("depth_prior.final_factor", 0.0),
        ("depth_prior.decay_steps", 0),
        ("depth_prior.min_track", 1),
        ("depth_prior.max_error", 0.0),
        ("depth_prior.unit", -1.0),
        ("depth_prior.unit", 0.0),
        ("depth_prior.space", "log"),
        ("depth_prior.align", "prayer"),
    ],
)
def test_the_parts_of_a_recipe_are_checked_like_its_stages(path: str, value: object) -> None:
    part, field = path.split(".")
    recipe = WHOLE[part]
    assert validate(recipe) is recipe
    with pytest.raises(RecipeError, match=path):
        validate(replace(recipe, **{part: replace(getattr(recipe, part), **{field: value})}))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rate", 0.0),
        ("rate", 1e30),
        ("rate_final", -1.0),
        ("decay_steps", 0),
        ("start", -1),
        ("prior", float("nan")),
        ("stretch", -1.0),
    ],
)
def test_learned_quantities_are_checked(field: str, value: object) -> None:
    assert validate(MOVING.with_learned(POSES, EXPOSURE)).learns("exposure")
    with pytest.raises(RecipeError, match=f"learned.exposure.{field}"):
        validate(MOVING.with_learned(POSES, replace(EXPOSURE, **{field: value})))  # type: ignore[arg-type]


def test_the_weight_of_a_prior_falls_log_linearly_to_its_share() -> None:
    prior = DepthPrior(final_factor=0.01, decay_steps=100)
    assert prior.weight_at(0) == 1
    assert prior.weight_at(50) == pytest.approx(0.1)
    assert prior.weight_at(100) == prior.weight_at(1000) == pytest.approx(0.01)
    assert NormalPrior(final_factor=1.0).weight_at(7) == 1


def test_poses_need_a_stage_that_moves_all_splats() -> None:
    still = replace(one(), stages=(Stage("s", 1, train={"sh0": "all"}, losses=L1),), learned=(POSES,))
    with pytest.raises(RecipeError, match="poses need a stage that trains the means of all splats, got none"):
        validate(still)


def test_a_group_may_be_written_by_an_action_of_the_same_stage() -> None:
    stage = Stage("s", 1, train={"sh0": "high_error"}, losses=L1, on_enter=(RANK_BY_ERROR,))
    later = Stage("t", 1, train=dict.fromkeys(ALPHA, "clones"), losses=L1, on_enter=(CLONE_IN_PLACE,))
    assert validate(Recipe("r", (stage, later))).name == "r"


def test_densification_may_freeze_opacity_only_without_resets() -> None:
    recipe = one(densify=GradDensify(reset_every=0), train={"means": "all"})
    assert validate(recipe) is recipe
    with pytest.raises(RecipeError, match="opacity"):
        validate(one(densify=GradDensify(reset_every=100), train={"means": "all"}))


def test_an_unknown_loss_or_densifier_is_refused_where_a_recipe_is_built() -> None:
    with pytest.raises(RecipeError, match=r"loss must be one of l1, .*, got 'distorsion'; did you mean distortion\?$"):
        LossTerm("distorsion", 1.0)
    with pytest.raises(RecipeError, match=r"loss must be one of l1, .*, got 'zzz'; gs2d.register_loss adds one"):
        replace(L1[0], kind="zzz")
    with pytest.raises(RecipeError, match="loss must be one of .*, got '3'"):
        LossTerm(3, 1.0)  # type: ignore[arg-type]
    with pytest.raises(RecipeError, match=r"densifier must be one of .*, got 'gradients'; did you mean gradient\?"):
        Densify("gradients")


def test_zero_and_none_are_written_differently() -> None:
    recipe = one(densify=GradDensify(scale_cull_start=0))  # the default, None, means something else
    assert to_json(recipe)["stages"][0]["densify"]["scale_cull_start"] == 0
    assert from_json(to_json(recipe)) == recipe
    assert apply_overrides(one(densify=GradDensify()), ["s.densify.scale_cull_start=0"]) == recipe


def test_with_loss_adds_a_term_to_all_stages_or_to_those_that_are_named() -> None:
    recipe = Recipe("r", (Stage("one", 10, losses=L1), Stage("two", 10, losses=L1)))
    term = LossTerm("l2", 0.5, start=3)
    assert [stage.losses for stage in recipe.with_loss(term).stages] == [(*L1, term)] * 2
    for stages in ("two", ["two"]):
        assert [stage.losses for stage in recipe.with_loss(term, stages=stages).stages] == [L1, (*L1, term)]
    assert [stage.losses for stage in recipe.stages] == [L1, L1]
    with pytest.raises(RecipeError, match="stage of recipe 'r' must be one of one, two; got 'tow'"):
        recipe.with_loss(term, stages="tow")
    with pytest.raises(RecipeError, match="stage 'one': loss 'l1' is there twice"):
        recipe.with_loss(LossTerm("l1", 1.0))
