"""Recipes in files and of guests: read by get_recipe, as `--recipe` does."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from gs2d.config.loss_registry import LOSSES
from gs2d.config.presets import RECIPES, about_recipe, get_recipe, register_recipe
from gs2d.config.recipe import LossTerm
from gs2d.config.registry import absent_guests
from gs2d.config.serialize import from_json, to_json
from gs2d.errors import RecipeError

FILE = '''
"""Mine."""
from dataclasses import replace
from gs2d.config.loss_registry import register_loss
from gs2d.config.presets import get_recipe
from gs2d.config.recipe import LossTerm

@register_loss("of-a-file")
def of_a_file(output, view):
    return output.color.mean()

def mine():
    first, *rest = get_recipe("2dgs-r").stages
    first = replace(first, losses=(*first.losses, LossTerm("of-a-file", 0.1)))
    return replace(get_recipe("2dgs-r"), name="mine", stages=(first, *rest))

ready = replace(mine(), name="ready")
number = 3

def broken():
    return 1 / 0
'''


@pytest.fixture
def file(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "recipes_of_mine.py"
    path.write_text(FILE)
    yield path
    LOSSES._objects.pop("of-a-file", None)


def test_a_python_file_has_recipes_and_functions_that_make_them(file: Path) -> None:
    made = get_recipe(f"{file}:mine")
    assert made.name == "mine"
    assert made.stages[0].losses[-1] == LossTerm("of-a-file", 0.1)
    assert get_recipe(f"{file}:ready") == replace(made, name="ready")  # the file was not run, or registered, again


@pytest.mark.parametrize(
    ("end", "message"),
    [
        ("", "--recipe"),
        (":mime", "mine"),
        (":number", "function"),
        (":broken", "ZeroDivisionError"),
    ],
)
def test_a_file_without_a_recipe_is_refused_in_one_line(file: Path, end: str, message: str) -> None:
    with pytest.raises(RecipeError, match=message) as error:
        get_recipe(f"{file}{end}")
    assert "\n" not in str(error.value)


def test_a_json_file_is_what_recipes_show_prints(tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_text(json.dumps(to_json(get_recipe("2dgs-r-k5"))))
    assert get_recipe(str(tmp_path / "mine.json")) == get_recipe("2dgs-r-k5")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(RecipeError, match="recipe"):
        get_recipe(str(tmp_path / "bad.json"))
    (tmp_path / "bad.json").write_text("[]")
    with pytest.raises(RecipeError, match="object"):
        get_recipe(str(tmp_path / "bad.json"))
    with pytest.raises(RecipeError, match="gs2d recipes NAME"):
        get_recipe(str(tmp_path / "none.json"))
    (tmp_path / "bad.json").write_text('{"name": "x"}')
    with pytest.raises(RecipeError, match="recipes"):
        get_recipe(str(tmp_path / "bad.json"))
    (tmp_path / "none.py").write_text("x = 1")
    with pytest.raises(RecipeError, match="function"):
        get_recipe(f"{tmp_path / 'none.py'}:x")
    (tmp_path / "bad.py").write_text("1 +")
    with pytest.raises(RecipeError, match="SyntaxError"):
        get_recipe(f"{tmp_path / 'bad.py'}:mine")


def test_a_run_with_missing_plug_ins_can_be_read_but_not_trained(file: Path) -> None:
    written = to_json(get_recipe(f"{file}:mine"))
    del LOSSES._objects["of-a-file"]
    with absent_guests():  # as a finished run is read
        assert from_json(written).stages[0].losses[-1].kind == "of-a-file"
    with pytest.raises(RecipeError, match="loss"):
        from_json(written)


def test_a_registered_recipe_is_found_by_its_name() -> None:
    @register_recipe("of-a-guest")
    def short() -> object:
        """Like 2DGS, under another name."""
        return replace(get_recipe("2dgs"), name="of-a-guest")

    assert get_recipe("of-a-guest").name == "of-a-guest"
    assert about_recipe("of-a-guest") == "Like 2DGS, under another name."
    del RECIPES._objects["of-a-guest"]
