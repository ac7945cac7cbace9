"""Recipes through JSON and back, and overrides from the command line."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import pytest

from gs2d.config.actions import CLONE_IN_PLACE
from gs2d.config.presets import RECIPES, get_recipe
from gs2d.config.quantities import EXPOSURE
from gs2d.config.recipe import GradDensify, LossTerm, Recipe
from gs2d.config.schedule import scale_schedule
from gs2d.config.serialize import apply_overrides, from_json, to_json
from gs2d.errors import RecipeError


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_survives_json(name: str) -> None:
    for recipe in (get_recipe(name), scale_schedule(get_recipe(name), 0.03)):
        text = json.dumps(to_json(recipe))
        assert from_json(json.loads(text)) == recipe
        assert json.dumps(to_json(from_json(json.loads(text)))) == text


def test_wrong_json_is_refused() -> None:
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
    assert "action must be one of rank_by_error, clone_in_place, got 'clone'" in broken(
        "data['stages'][2]['on_enter'][0]['name'] = 'clone'"
    )


def changed(*overrides: str) -> Recipe:
    return apply_overrides(get_recipe("2dgs-r"), overrides)


def test_overrides_reach_every_level() -> None:
    recipe = changed(
        "seed=7",
        "refine.iterations=2e3",
        "surface.densify.max_splats=1000",
        "surface.losses.normal_consistency.weight=0.1",
        "appearance.on_enter.rank_by_error.options.top_percent=5",
        "refine.on_enter.clone_in_place.options.opacity=preserve",
        "refine.train.means=null",
        "refine.train.opacity_logits=clones",
        "refine.lr.sh0=1",
    )
    surface, appearance, refine = recipe.stages
    assert recipe.seed == 7
    assert refine.iterations == 2000
    assert surface.densify == GradDensify(max_splats=1000)
    assert surface.losses[2].weight == 0.1
    assert appearance.on_enter[0].options["top_percent"] == 5
    assert refine.on_enter == (CLONE_IN_PLACE.with_options(opacity="preserve"),)
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
    said = {"edges": "camera", "where": "object"}
    overrides = [f"surface.losses.normal_consistency.options.{name}={value}" for name, value in said.items()]
    overrides += ["surface.losses.normal_consistency.start=2"]
    found = to_json(apply_overrides(get_recipe("2dgs"), overrides))["stages"][0]["losses"][2]
    assert found == plain | {"options": said, "start": 2}


def test_overrides_change_only_their_field() -> None:
    assert changed() == get_recipe("2dgs-r")
    assert changed("refine.iterations=5").stages[:2] == get_recipe("2dgs-r").stages[:2]


def test_learned_quantities_can_be_added_changed_and_removed() -> None:
    learning = changed(
        'learned=[{"name": "exposure", "rate": 0.05, "rate_final": 0.001, "stretch": 0, "prior": 0.001}]'
    )
    assert learning.learned == (EXPOSURE,)
    assert apply_overrides(learning, ["learned.exposure.rate=0.5"]).learned == (replace(EXPOSURE, rate=0.5),)
    assert apply_overrides(learning, ["learned=[]"]).learned == ()


def test_densification_can_be_switched_off() -> None:
    assert changed("surface.densify=null").stages[0].densify is None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("refine", "an override is stage.field=value"),
        ("=3", "an override is stage.field=value"),
        (
            "polish.iterations=3",
            "stages are surface, appearance, refine; fields are name, seed, sh_degree, init_points, learned",
        ),
        ("refine=3", "name a field of the stage: name, iterations"),
        ("refine.iteration=3", "no field 'iteration'; there is name, iterations"),
        ("refine.lr.meens=1", "; did you mean means?"),
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
