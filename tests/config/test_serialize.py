"""Recipes through JSON and back, and overrides from the command line."""

from __future__ import annotations

import json
from dataclasses import fields

import pytest

from gs2d.config.presets import RECIPES, get_recipe
from gs2d.config.recipe import CloneInPlace, Exposure, GradDensify, LossTerm, Recipe
from gs2d.config.schedule import scale_schedule
from gs2d.config.serialize import apply_overrides, from_json, to_json
from gs2d.errors import RecipeError


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_comes_back_from_json_equal(name: str) -> None:
    for recipe in (get_recipe(name), scale_schedule(get_recipe(name), 0.03)):
        text = json.dumps(to_json(recipe))
        assert from_json(json.loads(text)) == recipe
        assert json.dumps(to_json(from_json(json.loads(text)))) == text


def test_json_with_an_unknown_key_or_a_missing_one_or_a_wrong_type_is_an_error() -> None:
    def broken(change: str) -> str:
        data = to_json(get_recipe("2dgs-r"))
        exec(change, {"data": data})
        with pytest.raises(RecipeError) as caught:
            from_json(data)
        return str(caught.value)

    assert "has no field 'colour'" in broken("data['colour'] = 1")
    assert "stage 'refine'.lr has no field 'sh1'" in broken("data['stages'][2]['lr']['sh1'] = 1")
    assert "lacks the field 'iterations'" in broken("del data['stages'][0]['iterations']")
    assert "stage 'surface'.iterations must be an integer, got 'many'" in broken(
        "data['stages'][0]['iterations'] = 'many'"
    )
    assert "stage 'surface'.iterations must be an integer, got True" in broken("data['stages'][0]['iterations'] = True")
    assert "must be a list" in broken("data['stages'] = 3")
    assert "must be an object" in broken("data['stages'][0]['lr'] = [1]")
    assert "one of rank_by_error, clone_in_place; got 'clone'" in broken(
        "data['stages'][2]['on_enter'][0]['action'] = 'clone'"
    )


def changed(*overrides: str) -> Recipe:
    return apply_overrides(get_recipe("2dgs-r"), overrides)


def test_overrides_reach_every_level() -> None:
    recipe = changed(
        "seed=7",
        "refine.iterations=2e3",
        "surface.densify.max_splats=1000",
        "surface.losses.normal_consistency.weight=0.1",
        "appearance.on_enter.rank_by_error.top_percent=5",
        "refine.on_enter.clone_in_place.opacity=preserve",
        "refine.train.means=null",
        "refine.train.opacity_logits=clones",
        "refine.lr.sh0=1",
    )
    surface, appearance, refine = recipe.stages
    assert recipe.seed == 7
    assert refine.iterations == 2000
    assert surface.densify == GradDensify(max_splats=1000)
    assert surface.losses[2].weight == 0.1
    assert appearance.on_enter[0].top_percent == 5.0  # type: ignore[union-attr]
    assert refine.on_enter == (CloneInPlace(opacity="preserve"),)
    assert dict(refine.train) == {
        "quats": "all",
        "log_scales": "all",
        "sh0": "all",
        "shN": "all",
        "opacity_logits": "clones",
    }
    assert refine.lr.sh0 == 1.0


def test_every_field_of_a_loss_is_written_and_can_be_set() -> None:
    plain = to_json(get_recipe("2dgs"))["stages"][0]["losses"][2]
    assert plain.keys() == {entry.name for entry in fields(LossTerm)}
    said = {"edges": "camera", "edge_power": 2.0}
    overrides = [f"surface.losses.normal_consistency.options.{name}={value}" for name, value in said.items()]
    overrides += ["surface.losses.normal_consistency.every=2"]
    found = to_json(apply_overrides(get_recipe("2dgs"), overrides))["stages"][0]["losses"][2]
    assert found == plain | {"options": said, "every": 2}


def test_overrides_that_are_not_named_stay_as_they_were() -> None:
    assert changed() == get_recipe("2dgs-r")
    assert changed("refine.iterations=5").stages[:2] == get_recipe("2dgs-r").stages[:2]


def test_exposures_can_be_switched_on_changed_and_off() -> None:
    assert changed("exposure={}").exposure == Exposure()
    learning = changed("exposure={}")
    assert apply_overrides(learning, ["exposure.rate=0.01"]).exposure == Exposure(rate=0.01)
    assert apply_overrides(learning, ["exposure=null"]).exposure is None


def test_densification_can_be_switched_off() -> None:
    assert changed("surface.densify=null").stages[0].densify is None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("refine", "an override is stage.field=value"),
        ("=3", "an override is stage.field=value"),
        (
            "polish.iterations=3",
            "stages are surface, appearance, refine; fields are name, seed, sh_degree, init_points, exposure",
        ),
        ("refine=3", "name a field of the stage: name, iterations"),
        ("refine.iteration=3", "no field 'iteration'; there is name, iterations"),
        ("refine.iterations=many", "stage 'refine'.iterations must be an integer, got 'many'"),
        ("refine.iterations=2.5", "must be an integer, got 2.5"),
        ("refine.densify.every=3", "nothing below it"),
        ("appearance.losses.normal_consistency.weight=1", "no entry 'normal_consistency'; there is l1, ssim"),
        ("refine.train.opacity=all", "train must be one of means"),
        ("refine.train.means=heg", "the groups written so far are high_error, clones"),
        ("seed=-3", "seed must be an integer >= 0"),
    ],
)
def test_a_wrong_override_says_what_exists(override: str, message: str) -> None:
    with pytest.raises(RecipeError) as caught:
        changed(override)
    assert message in str(caught.value)
