"""Docstrings and messages name parameters, fields, functions and ``--set`` paths that exist."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import gs2d
from gs2d.cli.command_line import NAMES, options_of
from gs2d.config.presets import get_recipe
from gs2d.config.quantities import EXPOSURE, INTRINSICS, POSES
from gs2d.config.recipe import DepthPrior, NormalPrior
from gs2d.config.serialize import apply_overrides

PACKAGE = Path(gs2d.__file__).parent
FILES = sorted(path for path in PACKAGE.rglob("*.py") if path.name != "__main__.py")
TYPES = {"None", "Tensor", "Exception", "GiB"}  # and units, that need not be imported


def module_of(path: Path) -> str:
    parts = ["gs2d", *path.relative_to(PACKAGE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def entries(text: str, section: str) -> Iterator[tuple[str, str]]:
    """Yield the names and the type of each entry of a numpydoc section."""
    found = re.search(rf"^{section}\n-+\n(.*?)(?=^\S[^\n]*\n-+$|\Z)", text, re.M | re.S)
    for line in (found[1] if found else "").splitlines():
        if match := re.match(r"([\w*]+(?:, [\w*]+)*) : (.*)$", line):
            for name in match[1].split(", "):
                yield name.lstrip("*"), match[2]


def taken(node: ast.AST) -> set[str]:
    """Return the parameters of a function, or of the constructor of a class."""
    if isinstance(node, ast.ClassDef):
        made = [sub for sub in node.body if isinstance(sub, ast.FunctionDef) and sub.name in ("__init__", "__new__")]
        own = {
            sub.target.id for sub in node.body if isinstance(sub, ast.AnnAssign) and isinstance(sub.target, ast.Name)
        }
        return own.union(*map(taken, made))
    assert isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    a = node.args
    return {arg.arg for arg in (*a.posonlyargs, *a.args, *a.kwonlyargs, a.vararg, a.kwarg) if arg is not None}


def words_of(tree: ast.Module) -> set[str]:
    """Return the names that the code of a module uses."""
    words = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    words |= {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    return words | {alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}


def test_sections_name_parameters_fields_and_types_that_exist() -> None:
    assert not [f"{module_of(path)}: {fault}" for path in FILES for fault in faults_of(path)]


def faults_of(path: Path) -> list[str]:
    """Return the names in the docstrings of a module that do not exist."""
    module, tree = importlib.import_module(module_of(path)), tree_of(path)
    known = set(dir(module)) | words_of(tree) | TYPES
    wrong = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        text = ast.get_docstring(node) or ""
        wrong += [f"{node.name} has no {name}" for name, _ in entries(text, "Parameters") if name not in taken(node)]
        kind = getattr(module, node.name, None)
        if hasattr(kind, "__dataclass_fields__"):
            has = {*dir(kind), *(entry.name for entry in fields(kind))}
            wrong += [f"{node.name} has no {name}" for name, _ in entries(text, "Attributes") if name not in has]
        for section in ("Parameters", "Attributes"):
            for name, described in entries(text, section):
                types = re.findall(r"(?<![\w.])[A-Z][a-z]\w+", described)
                wrong += [f"{node.name}, {name}: no type {word}" for word in types if word not in known]
    return wrong


PATH = re.compile(r"--set (?!NAME=|partition\.)([\w.{}]+)=?")


def printed_paths() -> list[tuple[str, str]]:
    """Return the ``--set`` paths of all strings in the package, with their module; {} stands for a formatted value."""
    found = []
    for path in FILES:
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.JoinedStr):
                text = "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                text = node.value
            else:
                continue
            found += [(module_of(path), match[1].rstrip(".")) for match in PATH.finditer(text)]
    return sorted({(module, path) for module, path in found if set(path) - set("{}")})


def test_set_paths_in_messages_exist_in_a_recipe_with_other_stage_names() -> None:
    base = get_recipe("best")
    whole = replace(
        base,
        stages=(replace(base.stages[0], name="mine"),),
        learned=(EXPOSURE, POSES, INTRINSICS),
        depth_prior=DepthPrior(),
        normal_prior=NormalPrior(),
    )
    settings = {option.field for kind in NAMES.values() for option in options_of(kind) if option.mark.setting}
    found = [(module, path) for module, path in printed_paths() if path not in settings]
    assert len(found) > 8
    for module, path in found:
        if module.endswith("options"):  # help text: an example for the default recipe
            assert apply_overrides(base, [f"{path}=2000"]) != base
            continue
        words = re.sub(r"^(\{\}|STAGE)(?=\.)", "mine", path).split(".")
        node: Any = whole if words[0] != "mine" else whole.stages[0]
        for word in words[words[0] == "mine" :]:
            assert hasattr(node, word), f"{module} prints --set {path}: {type(node).__name__} has no {word}"
            node = getattr(node, word)
