"""What ``import gs2d`` offers: the names that the README and the guides use, documented, loaded when they are used."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest

import gs2d

FACE = (
    *("load_scene", "train", "Trainer", "Recipe", "Stage", "get_recipe", "list_recipes", "compute_losses"),
    *("rasterize", "rasterize_2dgs", "splat_errors", "read_splats", "write_splats", "extract_mesh", "evaluate"),
    *("Camera", "Splats", "Scene", "Mesh"),
)


def test_the_face_is_public() -> None:
    assert set(FACE) <= set(gs2d.__all__)


@pytest.mark.parametrize("name", [name for name in gs2d.__all__ if name != "__version__"])
def test_each_name_says_what_it_is(name: str) -> None:
    found = getattr(gs2d, name)
    text = inspect.getdoc(found) or ""
    first = text.partition("\n")[0]
    assert len(first) > 10
    assert first.endswith((".", ")", "."))
    assert not first.startswith(f"{name}(")  # what a dataclass without a docstring gets
    assert found.__module__.startswith("gs2d.")
    for folder in Path(gs2d.__file__).parent.iterdir():  # a function and a package of one name collide
        assert folder.name != name


def test_importing_gs2d_loads_nothing_else() -> None:
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
