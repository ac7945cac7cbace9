"""The controls change one thing of a recipe each."""

from __future__ import annotations

from dataclasses import replace

import pytest
from benchmarks import controls

from gs2d.config.presets import get_recipe
from gs2d.config.recipe import Recipe, Stage


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
