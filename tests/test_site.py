"""The documentation site: navigation and references are complete.

The slow test builds the site with Sphinx, as `make docs` does.
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import gs2d
from gs2d.cli.command_line import NAMES, options_of

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "docs" / "site"


def module(name: str) -> ModuleType:
    """Return a module of docs/site, which is no package."""
    spec = importlib.util.spec_from_file_location(f"site_{name}", SITE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


navigation = module("navigation")
PAGES: list[str] = navigation.pages()


def test_every_page_is_in_the_navigation() -> None:
    assert navigation.missing() == [], "add them to docs/README.md or docs/notebook/README.md"


def test_each_known_fault_names_test_files_that_exist() -> None:
    parts = re.split(r"^## ", (ROOT / "docs" / "known-faults.md").read_text(encoding="utf-8"), flags=re.M)[1:]
    assert len(parts) == 10
    for part in parts:
        named = re.findall(r"`(tests/[\w/]+\.py)`", part)
        assert named, part.splitlines()[0]
        assert [path for path in named if not (ROOT / path).is_file()] == []


def test_the_command_reference_has_every_option_of_every_command() -> None:
    text = module("reference").commands()
    for name, command in NAMES.items():
        assert f"\n### gs2d {name}\n" in text
        for option in options_of(command):
            assert f"\n`{option.usage}`\n: " in text, f"{name} {option.usage}"
    anchors = {line[4:].lower().replace(" ", "-") for line in text.splitlines() if line.startswith("### ")}
    assert set(re.findall(r"\]\(#([^)]+)\)", text)) <= anchors


def test_the_python_reference_has_all_public_names() -> None:
    text = module("reference").python()
    for name in set(gs2d.__all__) - {"__version__"}:
        assert f":: gs2d.{name}\n" in text


@pytest.mark.parametrize("page", ["docs/reference/commands.md", "docs/reference/python.md"])
def test_generated_pages_have_one_marker(page: str) -> None:
    assert (ROOT / page).read_text(encoding="utf-8").count("<!-- generated -->") == 1


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site as `make docs` does; warnings are errors."""
    for name in ("sphinx", "myst_parser", "furo"):
        pytest.importorskip(name, reason="the extra `docs` is not installed: make docs")
    home = tmp_path_factory.mktemp("docs")
    command = [sys.executable, "-m", "sphinx", "-E", "-W", "--keep-going", "-q", "-b", "html", "-c", str(SITE)]
    done = subprocess.run([*command, "-d", str(home / "trees"), str(ROOT), str(home / "site")],
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr
    return home / "site"


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(site: Path) -> None:
    for page in PAGES:
        html = (site / page).with_suffix(".html").read_text(encoding="utf-8")
        for target in re.findall(r'<a class="reference internal" href="([^"#]+)', html):
            assert (site / page).parent.joinpath(target).exists(), f"{page}: {target}"
