"""docs/extending.md shows the code of tests/plugin, which test_plugin.py installs and uses."""

from __future__ import annotations

import re
from pathlib import Path

import gs2d

ROOT = Path(__file__).parents[2]


def test_every_example_of_the_page_is_a_piece_of_the_package() -> None:
    page = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    code = (ROOT / "tests" / "plugin" / "gs2d_example.py").read_text(encoding="utf-8")
    entries = (ROOT / "tests" / "plugin" / "pyproject.toml").read_text(encoding="utf-8")
    examples = re.findall(r"```(python|toml)\n(.*?)```", page, flags=re.DOTALL)
    for language, example in examples:
        assert example in (code if language == "python" else entries), example
    kinds = {name for name in gs2d.__all__ if name.startswith("register_")}
    for text in (page, code):
        assert set(re.findall(r"^@gs2d\.(register_\w+)\(", text, flags=re.MULTILINE)) == kinds
