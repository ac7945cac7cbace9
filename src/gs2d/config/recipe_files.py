"""Recipes in files: ``file.json`` and ``file.py:name``. Pure Python; never imports torch by itself."""

from __future__ import annotations

import importlib.util
import json
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from gs2d.config.recipe import Recipe, validate
from gs2d.config.registry import did_you_mean
from gs2d.config.serialize import from_json
from gs2d.errors import Gs2dError, RecipeError

__all__ = ["is_recipe_file", "read_recipe_file", "recipe_from", "short_name"]


def is_recipe_file(name: str) -> bool:
    """Return whether a recipe name is a file."""
    return name.endswith((".json", ".py")) or ".py:" in name


def short_name(name: str) -> str:
    """Return the name of a recipe; "mine" for ``dir/mine.json`` and ``file.py:mine``."""
    if not is_recipe_file(name):
        return name
    return Path(name).stem if name.endswith(".json") else name.rpartition(":")[2]


def read_recipe_file(name: str) -> Recipe:
    """Read ``file.json``, or run ``file.py`` once and return its recipe ``name``.

    Raises RecipeError if the file does not exist, cannot be read or run, or has no recipe of this name.
    """
    if name.endswith(".json"):
        return _from_json_file(Path(name))
    file, colon, attribute = name.rpartition(":")
    path = Path(file if colon else name)
    if not path.is_file():
        raise RecipeError(
            f"{path} must be a Python file with a recipe, got no such file; give FILE.py:NAME, or a name that "
            "`gs2d recipes` lists"
        )
    module = _run(path.resolve())
    own = _recipes_in(module)
    if not own:
        raise RecipeError(
            f"{path} must hold a gs2d.Recipe, or a function that returns one, got neither; docs/extending.md has "
            "an example"
        )
    if not colon:
        raise RecipeError(f"{path} needs the name of a recipe: --recipe {path}:NAME, one of {', '.join(own)}")
    if not hasattr(module, attribute):
        meant = did_you_mean(attribute, own) or f"; it has {', '.join(own)}"
        raise RecipeError(f"{path} has no recipe {attribute!r}{meant}")
    return recipe_from(getattr(module, attribute), name)


def recipe_from(source: Any, where: str) -> Recipe:
    """Return a recipe, or the result of a function without arguments, validated.

    Raises RecipeError if the result is no recipe.
    """
    try:
        value = source() if callable(source) else source
    except Gs2dError:
        raise
    except Exception as error:  # a plug-in may raise anything
        raise RecipeError(f"{where} cannot be created: {_line(error)}") from error
    if not isinstance(value, Recipe):
        raise RecipeError(f"{where} must be a gs2d.Recipe, or a function that returns one, got {type(value).__name__}")
    return validate(value)


def _from_json_file(path: Path) -> Recipe:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RecipeError(
            f"{path} must be a recipe in JSON, got: {error.strerror or error}; `gs2d recipes NAME` prints one"
        ) from error
    except (ValueError, RecursionError) as error:
        raise RecipeError(
            f"{path} must hold a recipe in JSON, as `gs2d recipes NAME` prints it, got: {error}"
        ) from error
    if not isinstance(data, dict):
        raise RecipeError(f"{path} must hold a recipe, an object of JSON, got {type(data).__name__}")
    try:
        return from_json(data)
    except RecursionError as error:
        raise RecipeError(f"{path} must hold a recipe, got values nested too deeply to read") from error
    except RecipeError as error:
        raise RecipeError(f"{path}: {error}; `gs2d recipes NAME` prints a whole one") from error


@cache  # a file registers its names once
def _run(path: Path) -> ModuleType:
    name = f"gs2d_recipe_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look for their module there
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # it may raise anything
        del sys.modules[name]
        raise RecipeError(f"{path} must run as a Python file, got {_line(error)}; mend it and try again") from error
    return module


def _recipes_in(module: ModuleType) -> list[str]:
    """Return the names of the recipes and functions that a file defines."""
    return [
        name
        for name, value in vars(module).items()
        if isinstance(value, Recipe) or (callable(value) and getattr(value, "__module__", "") == module.__name__)
    ]


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
