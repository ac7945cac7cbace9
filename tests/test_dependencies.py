"""Dependencies: every import is declared, and every licence is compatible with Apache-2.0."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import gs2d

PACKAGE = Path(gs2d.__file__).parent
PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = {name: lines for name, lines in PROJECT["optional-dependencies"].items() if name not in ("dev", "docs")}
DECLARED = [*PROJECT["dependencies"], *(line for lines in EXTRAS.values() for line in lines)]
UNFREE = re.compile(r"\bA?GPL|(?<!Lesser )General Public License|non-?commercial|proprietary", re.IGNORECASE)
# Packages whose metadata name such a licence, each checked by hand.
ALLOWED = {
    "scipy": "BSD; the text names the run-time library of gfortran in its wheel (GPL 3 with the exception for GCC's "
    "run-time libraries, which lets any program carry it)",
    "matplotlib": "its own; the text names FreeType, in its wheel, under the FTL or the GPL 2: the FTL is taken",
    "nvidia-cuda-nvrtc": "NVIDIA's, of extras only: may be passed on with a program, as torch's wheels do",
}
# Imported if the user has installed one of them, never declared: their wheels contain LGPL code (HEIC).
USERS_OWN = {"pi_heif", "pillow_heif"}


def needed(requirements: Iterable[str], found: set[str]) -> set[str]:
    """Return the installed packages among requirements, with their own requirements."""
    for requirement in map(Requirement, requirements):
        name = canonicalize_name(requirement.name)
        if name in found or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        try:
            rest = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue  # belongs to an extra that is not installed
        found.add(name)
        needed(rest, found)
    return found


def unfree(metadata: Iterable[tuple[str, str]]) -> list[str]:
    """Return the licence texts in the metadata of a package that forbid its use."""
    said = [line for key, text in metadata if key in ("License-Expression", "License") for line in text.splitlines()]
    said += [text for key, text in metadata if key == "Classifier" and text.startswith("License")]
    return [line.strip() for line in said if UNFREE.search(line)]


@pytest.mark.parametrize("name", sorted(needed(DECLARED, set())))
def test_no_dependency_has_a_gpl_or_non_commercial_licence(name: str) -> None:
    against = unfree(importlib.metadata.metadata(name).items())  # type: ignore[attr-defined]
    assert bool(against) == (name in ALLOWED), f"{name}: {against[:3]}; look into it, then ALLOWED or another package"


@pytest.mark.parametrize(
    ("key", "text", "is_free"),
    [
        ("License-Expression", "MIT AND GPL-3.0-or-later", False),
        ("License", "GNU Affero General Public License v3", False),
        ("License", "AGPLv3", False),
        ("License", "CC BY-NC 4.0 (non-commercial)", False),
        ("Classifier", "License :: OSI Approved :: GNU General Public License v2 (GPLv2)", False),
        ("Classifier", "Topic :: GPL", True),
        ("License-Expression", "LGPL-2.1-or-later", True),
        ("License", "MIT", True),
    ],
)
def test_the_check_detects_such_a_licence(key: str, text: str, is_free: bool) -> None:
    assert (not unfree([(key, text)])) == is_free


def imported(path: Path) -> Iterator[str]:
    """Yield the top-level modules that a file imports, lazily or not."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        yield from (name.partition(".")[0] for name in names)


def test_every_imported_package_is_declared() -> None:
    declared = {canonicalize_name(Requirement(line).name) for line in DECLARED}
    packages = importlib.metadata.packages_distributions()
    modules = {name for path in PACKAGE.rglob("*.py") for name in imported(path)}
    foreign = modules - set(sys.stdlib_module_names) - {"gs2d", *USERS_OWN}
    assert "numpy" in foreign
    unknown = {
        name for name in foreign if name in packages and not declared & set(map(canonicalize_name, packages[name]))
    }
    assert not unknown, "declare them in pyproject.toml, or use what is declared"


def test_the_extras_of_the_container_exist() -> None:
    text = (Path(__file__).parents[1] / "Dockerfile").read_text(encoding="utf-8")
    (extras,) = re.findall(r"^ARG EXTRAS=(.*)$", text, re.M)
    assert set(extras.split(",")) <= set(EXTRAS)
