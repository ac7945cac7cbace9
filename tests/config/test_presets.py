"""The named recipes: what each row of the paper's tables trains."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gs2d.config.actions import CLONE_IN_PLACE, RANK_BY_ERROR
from gs2d.config.presets import (
    DEPTH_WEIGHT,
    RECIPES,
    TABLES,
    get_recipe,
    with_depth_prior,
    with_normal_prior,
)
from gs2d.config.prior_settings import DepthPrior, NormalPrior
from gs2d.config.recipe import ALL, GradDensify, Recipe, Stage, validate
from gs2d.errors import RecipeError


def weights(stage: Stage) -> dict[str, tuple[float | None, int]]:
    return {term.kind: (term.weight, term.start) for term in stage.losses}


@pytest.mark.parametrize("name", RECIPES)
def test_every_named_recipe_is_valid_and_carries_its_name(name: str) -> None:
    recipe = get_recipe(name)
    assert validate(recipe) is recipe
    assert recipe.name == name
    assert RECIPES[name].about


def test_every_row_of_every_table_names_a_recipe() -> None:
    assert set(TABLES) == {"regularisation", "benchmark", "k", "freeze", "modules", "absgs"}
    for rows in TABLES.values():
        for name in rows.values():
            assert name in RECIPES


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


def test_2dgs_60k_trains_as_long_as_2dgs_r() -> None:
    control = get_recipe("2dgs-60k")
    assert control.stages[0] == get_recipe("2dgs").stages[0]
    assert control.iterations == get_recipe("2dgs-r").iterations == 60_000
    more = control.stages[1]
    assert more.moments == "kept"
    assert more.densify is None
    assert more.lr.means_at(1) == pytest.approx(1.6e-6)
    assert weights(more)["normal_consistency"] == (0.05, 0)


@pytest.mark.parametrize(
    ("name", "nc", "distortion"),
    [
        ("2dgs-no-nc", None, None),
        ("2dgs-distortion-no-nc", None, (None, 3000)),
        ("2dgs-distortion", (0.05, 7000), (None, 3000)),
        ("2dgs-nc-0.1", (0.1, 7000), None),
        ("2dgs-nc-0.3", (0.3, 7000), None),
    ],
)
def test_regularizer_rows(name: str, nc: object, distortion: object) -> None:
    (stage,) = get_recipe(name).stages
    assert weights(stage).get("normal_consistency") == nc
    assert weights(stage).get("distortion") == distortion  # weight None: the protocol's


def frozen(stage: Stage) -> set[str]:
    return set(ALL) - set(stage.train)


def test_module_rows() -> None:
    def facts(recipe: Recipe) -> tuple[bool, bool, bool]:
        last = recipe.stages[-1]
        clone = CLONE_IN_PLACE in last.on_enter
        return clone, "opacity_logits" in frozen(last), "normal_consistency" in weights(last)

    rows = {row: get_recipe(name) for row, name in TABLES["modules"].items()}
    assert rows["(I)"].stages == get_recipe("2dgs").stages
    assert facts(rows["(II)"]) == (True, False, False)
    assert facts(rows["(III)"]) == (True, True, False)
    assert facts(rows["(IV)"]) == (True, True, True)
    assert rows["(IV)"].stages == get_recipe("2dgs-r").stages


def test_absgs_rows_densify_in_stage_3_instead_of_the_clone() -> None:
    default, adjusted = (get_recipe(f"2dgs-r-absgs-{x}").stages[2] for x in "da")
    for stage in (default, adjusted):
        assert stage.on_enter == ()
        assert frozen(stage) == set()
        assert stage.densify is not None
        assert stage.densify.absolute
        assert not stage.densify.resets(500, white=True)
    assert default.densify is not None
    assert adjusted.densify is not None
    d = default.densify
    assert (d.grad_threshold, d.abs_threshold, d.percent_dense, d.opacity_cull) == (2e-4, 4e-4, 0.001, 0.005)
    assert (d.cap_every, d.reset_every) == (500, 3000)
    assert adjusted.densify.abs_threshold < d.abs_threshold
    assert adjusted.densify.percent_dense < d.percent_dense


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
