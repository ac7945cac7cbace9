"""The controls change one thing of a recipe each."""

from __future__ import annotations

from dataclasses import replace

import pytest
from benchmarks import controls

from gs2d.config.presets import get_recipe
from gs2d.config.recipe import GradDensify, Recipe, Stage


@pytest.mark.parametrize("name", controls.CONTROLS)
def test_a_control_is_a_recipe_file_that_carries_its_name(name: str) -> None:
    assert get_recipe(controls.spec(name)).name == name
    assert controls.spec("2dgs") == "2dgs"


def last_stages(recipe: Recipe, base: str) -> tuple[Stage, Stage]:
    plain = get_recipe(base)
    assert recipe.stages[:-1] == plain.stages[:-1]
    return recipe.stages[-1], plain.stages[-1]


@pytest.mark.parametrize(
    ("recipe", "base"), [(controls.restart_2dgs_r(), "2dgs-r"), (controls.restart_2dgs_60k(), "2dgs-60k")]
)
def test_a_restart_lets_the_rate_of_the_means_fall_once_more(recipe: Recipe, base: str) -> None:
    last, plain = last_stages(recipe, base)
    assert replace(last, lr=plain.lr) == plain
    assert last.lr.means_at(0) == pytest.approx(1.6e-4)
    assert last.lr.means_at(last.iterations - 100) > last.lr.means_at(last.iterations) == pytest.approx(1.6e-6)


def test_other_controls_change_losses_or_entry_actions_alone() -> None:
    last, plain = last_stages(controls.no_nc_late(), "2dgs-60k")
    assert [term.kind for term in last.losses] == ["l1", "ssim"]
    assert replace(last, losses=plain.losses) == plain
    last, plain = last_stages(controls.no_clone(), "2dgs-r")
    assert replace(last, on_enter=plain.on_enter) == plain
    assert last.on_enter == ()
    edges = [[term.edges for term in stage.losses] for stage in controls.edges_camera().stages]
    assert edges == [["undefined", "undefined", "camera"]] * 2


def test_a_dense_start_is_fitted_and_not_reset() -> None:
    plain, dense, still = get_recipe("2dgs"), controls.dense(), controls.dense_still()
    assert dense.dense_start is not None
    assert dense.dense_start.fit is not None
    assert dense.dense_start == still.dense_start
    assert isinstance(plain.stages[0].densify, GradDensify)
    assert dense.stages[0] == replace(plain.stages[0], densify=replace(plain.stages[0].densify, reset_every=0))
    assert still.stages[0] == replace(plain.stages[0], densify=None)
