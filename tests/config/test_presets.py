"""The named recipes: what each row of the paper's tables trains."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gs2d.config.actions import CLONE_IN_PLACE, RANK_BY_ERROR
from gs2d.config.presets import (
    DEPTH_WEIGHT,
    RECIPES,
    about_recipe,
    get_recipe,
    with_depth_prior,
    with_normal_prior,
)
from gs2d.config.recipe import ALL, DepthPrior, GradDensify, NormalPrior, Stage, validate
from gs2d.errors import RecipeError


def weights(stage: Stage) -> dict[str, tuple[float | None, int]]:
    return {term.kind: (term.weight, term.start) for term in stage.losses}


@pytest.mark.parametrize("name", RECIPES)
def test_every_named_recipe_is_valid_and_carries_its_name(name: str) -> None:
    recipe = get_recipe(name)
    assert validate(recipe) is recipe
    assert recipe.name == name
    assert about_recipe(name)


def test_2dgs_is_the_official_recipe() -> None:
    (stage,) = get_recipe("2dgs").stages
    assert stage.iterations == 30_000
    assert weights(stage) == {"l1": (0.8, 0), "ssim": (0.2, 0), "normal_consistency": (0.05, 7000)}
    assert dict(stage.train) == dict.fromkeys(ALL, "all")
    assert stage.densify == GradDensify()
    assert stage.sh_interval == 1000
    lr = stage.lr
    assert (lr.means, lr.means_final, lr.means_decay_steps) == (1.6e-4, 1.6e-6, 30_000)
    assert (lr.sh0, lr.shN, lr.opacity_logits) == (2.5e-3, 1.25e-4, 0.05)
    assert (lr.log_scales, lr.quats) == (5e-3, 1e-3)
    assert (lr.beta1, lr.beta2, lr.eps) == (0.9, 0.999, 1e-15)


def test_2dgs_r_has_the_three_stages_of_the_paper() -> None:
    surface, appearance, refine = get_recipe("2dgs-r").stages
    assert surface == get_recipe("2dgs").stages[0]
    assert [s.iterations for s in (surface, appearance, refine)] == [30_000, 10_000, 20_000]
    assert appearance.on_enter == (RANK_BY_ERROR,)
    assert dict(appearance.train) == {"sh0": "high_error", "shN": "high_error"}
    assert weights(appearance) == {"l1": (0.8, 0), "ssim": (0.2, 0)}
    assert refine.on_enter == (CLONE_IN_PLACE,)
    assert dict(refine.train) == {n: "all" for n in ("means", "quats", "log_scales", "sh0", "shN")}
    assert weights(refine) == {"l1": (0.8, 0), "ssim": (0.2, 0), "normal_consistency": (0.05, 0)}
    for stage in (appearance, refine):
        assert stage.densify is None
        assert stage.lr.means_at(1) == pytest.approx(1.6e-6)
        assert stage.moments == "fresh"
        assert stage.sh_interval == 0


def test_an_unknown_name_suggests_a_near_one() -> None:
    with pytest.raises(RecipeError, match="2dgs-r-k10"):
        get_recipe("2dgs-r-k100")


@pytest.mark.parametrize("base", ["2dgs", "2dgs-60k", "2dgs-r"])
def test_known_depths_are_compared_while_all_splats_move(base: str) -> None:
    plain, knowing = get_recipe(base), with_depth_prior(get_recipe(base))
    assert plain.depth_prior is None
    assert knowing.depth_prior == DepthPrior()
    for before, after in zip(plain.stages, knowing.stages, strict=True):
        assert weights(after) == weights(before) | ({"depth_prior": (DEPTH_WEIGHT, 0)} if before.moves_all else {})
        assert replace(after, losses=before.losses) == before
    assert with_depth_prior(knowing) == knowing
    both = with_normal_prior(knowing)
    assert (both.name, both.normal_prior) == (f"{base}-depth-normals", NormalPrior())
    assert validate(both) == with_normal_prior(both)
    starts = [t.start for s in both.stages for t in s.losses if t.kind == "normal_prior"]
    assert starts == [7_000, 0][: len(starts)]
