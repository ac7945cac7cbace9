"""Recipes as JSON, and overrides ``stage.field=value`` of the command line.

The reader is strict: an unknown or missing key, or a value of another type, raises a :class:`RecipeError` with its
position. Pure Python; never imports torch.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from gs2d.config.densify import Densify
from gs2d.config.recipe import GradDensify, Recipe, validate
from gs2d.config.registry import did_you_mean
from gs2d.errors import RecipeError


def to_json(recipe: Recipe) -> dict[str, Any]:
    """Return a recipe, with every field, as plain dicts, lists, numbers and strings."""
    encoded = encode(recipe)
    assert isinstance(encoded, dict)
    return encoded


def from_json(data: Mapping[str, Any]) -> Recipe:
    """Return the recipe of a result of :func:`to_json`, validated.

    Raises RecipeError if a key is unknown or missing, or a value has another type.
    """
    recipe = decode(data, Recipe, "recipe")
    assert isinstance(recipe, Recipe)
    return validate(recipe)


def apply_overrides(recipe: Recipe, overrides: Sequence[str]) -> Recipe:
    """Return a recipe with changed fields, validated.

    ``overrides``: ``field=value`` for the recipe (``seed=3``) and ``stage.field=value`` for a stage. Dots reach deeper
    fields: ``surface.densify.grad_threshold=1e-4``, ``refine.lr.sh0=0.001``; losses by their kind,
    ``surface.losses.normal_consistency.weight=0.1``, their options by
    ``surface.losses.normal_consistency.options.where=object``; entry actions by their name,
    ``refine.on_enter.clone_in_place.options.opacity=preserve``; ``refine.train.means=null`` freezes an attribute.
    Values are JSON; other text is a string. Raises RecipeError if a field is unknown, or a value has another type.
    """
    data = to_json(recipe)
    for override in overrides:
        path, equals, text = override.partition("=")
        words = path.strip().split(".")
        if not equals or not all(words):
            raise RecipeError(f"an override is stage.field=value, got {override!r}")
        _set(data, words, _parse(text.strip()), override)
    return from_json(data)


def _parse(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def _set(data: dict[str, Any], words: list[str], value: Any, override: str) -> None:
    """Put a value at a path inside the JSON form of a recipe."""
    node: Any = data
    if words[0] not in data or words[0] == "stages":
        names = [stage["name"] for stage in data["stages"]]
        plain = [key for key in data if key != "stages"]
        if words[0] not in names:
            raise RecipeError(
                f"override {override!r}: no stage or field {words[0]!r}; stages are {', '.join(names)}; "
                f"fields are {', '.join(plain)}"
            )
        node = data["stages"][names.index(words[0])]
        words = words[1:]
        if not words:
            raise RecipeError(f"override {override!r}: name a field of the stage: {', '.join(node)}")
    for depth, word in enumerate(words):
        last, above = depth == len(words) - 1, words[depth - 1] if depth else ""
        if isinstance(node, list) and not last:
            node = _entry(node, word, override)
        elif isinstance(node, dict) and last and above == "train" and value is None:
            node.pop(word, None)
        elif isinstance(node, dict) and last and above in ("train", "options"):
            node[word] = value  # validate() checks attributes; the loss, densifier, action or quantity its options
        elif isinstance(node, dict) and word in node:
            if last:
                node[word] = value
            else:
                node = node[word]
        else:
            available = ", ".join(node) if isinstance(node, dict) else "nothing below it (it is null or a plain value)"
            near = did_you_mean(word, list(node)) if isinstance(node, dict) else ""
            raise RecipeError(f"override {override!r}: no field {word!r}; there is {available}{near}")


def _entry(entries: list[Any], word: str, override: str) -> Any:
    """Return the loss of a kind, or the action or learned quantity of a name."""
    nodes = [entry if isinstance(entry, dict) else {} for entry in entries]
    tags = [str(entry.get("kind", entry.get("name", "?"))) for entry in nodes]
    if word not in tags:
        raise RecipeError(
            f"override {override!r}: no entry {word!r}; there is {', '.join(tags) or 'none'}{did_you_mean(word, tags)}"
        )
    return entries[tags.index(word)]


def encode(value: Any) -> Any:
    """Return a dataclass as plain dicts, lists, numbers and strings."""
    if is_dataclass(value) and not isinstance(value, type):
        return {entry.name: encode(getattr(value, entry.name)) for entry in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): encode(entry) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return [encode(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value


def decode(value: Any, kind: Any, where: str) -> Any:
    """Return a JSON value as an annotated type; ``where`` is its name in errors.

    Raises RecipeError if a field is unknown or missing, or a value has another type.
    """
    origin = get_origin(kind)
    if origin in (Union, UnionType):
        return _decode_union(value, get_args(kind), where)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise RecipeError(f"{where} must be a list, got {value!r}")
        return tuple(decode(entry, get_args(kind)[0], f"{where}[{i}]") for i, entry in enumerate(value))
    if origin is not None and issubclass(origin, Mapping):
        if not isinstance(value, Mapping):
            raise RecipeError(f"{where} must be an object, got {value!r}")
        return {str(key): decode(entry, get_args(kind)[1], f"{where}.{key}") for key, entry in value.items()}
    if is_dataclass(kind):
        assert isinstance(kind, type)
        return _decode_dataclass(value, kind, where)
    return _decode_plain(value, kind, where)


def _decode_union(value: Any, kinds: tuple[Any, ...], where: str) -> Any:
    if value is None and NoneType in kinds:
        return None
    kinds = tuple(kind for kind in kinds if kind is not NoneType)
    if Densify in kinds:  # by its name, or by the fields of 2DGS's own
        named = isinstance(value, Mapping) and "name" in value
        kinds = (Densify if named else GradDensify,)
    (only,) = kinds
    return decode(value, only, where)


@cache  # typing evaluates all names each time: some ms for a recipe
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _decode_dataclass(value: Any, kind: type, where: str) -> Any:
    if not isinstance(value, Mapping):
        raise RecipeError(f"{where} must be an object, got {value!r}")
    hints = _hints(kind)
    declared = {entry.name: entry for entry in fields(kind)}
    for key in value:
        if key not in declared:
            raise RecipeError(f"{where} has no field {key!r}; it has {', '.join(declared)}")
    for name, entry in declared.items():
        if name not in value and entry.default is MISSING and entry.default_factory is MISSING:
            raise RecipeError(f"{where} lacks the field {name!r}")
    label = value.get("name", "") if isinstance(value.get("name", ""), str) else ""
    inner = f"stage {label!r}" if kind.__name__ == "Stage" else where
    return kind(**{name: decode(entry, hints[name], f"{inner}.{name}") for name, entry in value.items()})


def _decode_plain(value: Any, kind: Any, where: str) -> Any:
    if kind is Any:
        return value
    if kind is Path and isinstance(value, str):
        return Path(value)
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        with suppress(OverflowError):  # a whole number of 400 digits is none
            return float(value)
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(value, kind) and not (kind is int and isinstance(value, bool)):
        return value
    names = {Path: "a path", int: "an integer", float: "a number", str: "a string", bool: "true or false"}
    raise RecipeError(f"{where} must be {names[kind]}, got {value!r}")
