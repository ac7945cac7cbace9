"""The public interface of ``import gs2d``: documented names that are loaded lazily."""

from __future__ import annotations

import ast
import inspect
import os
import re
import subprocess
import sys
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path

import pytest

import gs2d

FACE = """
    load_scene train Trainer Recipe Stage get_recipe list_recipes compute_losses rasterize rasterize_2dgs
    splat_errors splat_sums read_splats write_splats extract_mesh evaluate Camera Splats Scene Mesh
    MeshOptions TrainOptions Protocol LossTerm register_loss register_action register_densifier
    register_quantity register_recipe register_reader register_backend register_format register_section
    perturb_pose rgb_to_sh0 normals_from_depth write_mesh
""".split()


def test_public_names_are_public_in_their_modules() -> None:
    assert set(FACE) <= set(gs2d.__all__)


@pytest.mark.parametrize("name", [name for name in gs2d.__all__ if name != "__version__"])
def test_each_public_name_has_a_docstring(name: str) -> None:
    found = getattr(gs2d, name)
    text = inspect.getdoc(found) or ""
    first = text.partition("\n")[0]
    assert len(first) > 10
    assert first.endswith((".", ")", "."))
    assert not first.startswith(f"{name}(")  # what a dataclass without a docstring gets
    assert found.__module__.startswith("gs2d.")
    for folder in Path(gs2d.__file__).parent.iterdir():  # a function and a package of one name collide
        assert folder.name != name


def documented(text: str) -> dict[str, str]:
    """Return the entries of the Parameters and Attributes of a docstring, with their descriptions."""
    found: dict[str, str] = {}
    for section in re.findall(r"^(?:Parameters|Attributes)\n-+\n(.*?)(?=^\w[^\n]*\n-+$|\Z)", text, re.M | re.S):
        names: list[str] = []
        for line in section.splitlines():
            if match := re.match(r"([\w*]+(?:, [\w*]+)*)(?: : (.*))?$", line):
                names = match[1].replace("*", "").split(", ")
                found |= dict.fromkeys(names, match[2] or "")
            else:
                found |= {name: found[name] + line for name in names}
    return found


def field_strings(kind: type) -> set[str]:
    """Return the fields of a class that have a string below them."""
    body = ast.parse(inspect.getsource(kind)).body[0].body  # type: ignore[attr-defined]
    pairs = pairwise(body)
    return {
        field.target.id
        for field, below in pairs
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr)
    }


@pytest.mark.parametrize("name", [name for name in gs2d.__all__ if name != "__version__"])
def test_each_parameter_and_field_is_documented_and_each_array_has_a_shape(name: str) -> None:
    found = getattr(gs2d, name)
    said = documented(inspect.getdoc(found) or "")
    if is_dataclass(found):
        assert isinstance(found, type)
        own = set().union(*(field_strings(kind) for kind in found.__mro__ if is_dataclass(kind)))
        wanted = {entry.name for entry in fields(found) if "Suppress" not in str(entry.type)} - own
    elif inspect.isclass(found) and issubclass(found, Exception):
        return
    else:
        wanted = set(inspect.signature(found).parameters) - {"self"}
    assert wanted <= set(said), f"{name}: {sorted(wanted - set(said))} are not documented"
    shapeless = [entry for entry, text in said.items() if re.search("ndarray|Tensor", text) and "[" not in text]
    assert not shapeless
    if inspect.isfunction(found) and inspect.signature(found).return_annotation not in ("None", None):
        assert "Returns\n-------" in (inspect.getdoc(found) or "")


def test_importing_gs2d_loads_no_other_package() -> None:
    code = "import sys; before = set(sys.modules); import gs2d; print(*sorted(set(sys.modules) - before))"
    environment = os.environ | {"PYTHONPATH": str(Path(gs2d.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    loaded = done.stdout.split()
    assert [name for name in loaded if name.startswith("gs2d")] == ["gs2d"]
    assert not {"torch", "numpy", "PIL", "scipy"} & set(loaded)
    assert len(loaded) < 40  # of the standard library, typing for the most part


def test_recipes_are_listed_in_order_and_found_by_name() -> None:
    names = gs2d.list_recipes()
    assert names[0] == "best"
    assert "2dgs" in names
    assert "2dgs-r" in names
    assert all(gs2d.get_recipe(name).name == name for name in names)
