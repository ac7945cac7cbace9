"""Upper limits on what users have to learn: commands, options, settings, recipes, fields of a recipe, pages to read.

A commit that raises a limit states in its message what the addition replaces.
"""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

import gs2d
from gs2d.cli.command_line import NAMES, options_of
from gs2d.config.recipe import Recipe


def nested(kind: Any) -> set[type]:
    """Return the dataclasses within a type: itself, of its arguments, and of its fields."""
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return set().union(*(nested(part) for part in get_args(kind)))
    hints = get_type_hints(kind)
    return {kind}.union(*(nested(hints[field.name]) for field in fields(kind)))


def counted() -> dict[str, int]:
    """Return the counts, from the parser and the registries."""
    options = [(name, option) for name, command in NAMES.items() for option in options_of(command)]
    return {
        "commands": len(NAMES),
        "options of all commands": len(options),
        "options by name": len({option.name for _, option in options if option.flags}),
        "settings by name": len({option.name for _, option in options if option.mark.setting}),
        "recipes": len(gs2d.list_recipes()),
        "fields of recipes": sum(len(fields(kind)) for kind in nested(Recipe)),
    }


LIMITS = {
    "commands": 16,
    "options of all commands": 252,
    "options by name": 70,
    "settings by name": 25,
    "recipes": 22,
    "fields of recipes": 93,
}


DOCS = Path(__file__).parents[1] / "docs"
INSIDE = {"architecture", "kernels", "math"}  # pages of docs/ for those who change gs2d


def test_there_are_no_more_pages_and_words_than_the_limits() -> None:
    user = [page for folder in (".", "guides", "tutorials", "reference") for page in (DOCS / folder).glob("*.md")]
    texts = [page.read_text(encoding="utf-8") for page in user if page.stem not in INSIDE]
    words = sum(len(re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S).split()) for text in texts)  # without code
    notebook = [page.read_text(encoding="utf-8") for page in (DOCS / "notebook").glob("*.md")]
    assert len(texts) <= 35
    assert words <= 21_000  # with the generated list of options, of 3,000 words: 24,000
    assert sum(len(text.split()) for text in notebook) <= 45_000
    assert len((DOCS.parent / "README.md").read_text(encoding="utf-8").splitlines()) <= 90


def test_there_are_no_more_than_the_limits() -> None:
    assert {what: count for what, count in counted().items() if count > LIMITS[what]} == {}
