"""The house rules that a machine can check: floors, file lengths, public names, what imports without torch."""

from __future__ import annotations

import ast
import graphlib
import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import gs2d

PACKAGE = Path(gs2d.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
MAX_LINES = 700  # soft: a file is one thing that a reader looks for

# Floors: a module imports from its own unit or from a lower floor. A package without an entry of its own for a module
# has the floor of the package. Two units of one floor do not import each other, except where PEERS says so.
FLOORS = {
    "errors": 0,
    "check": 0,
    "disk": 0,
    "extras": 0,
    "memory": 0,
    "recipe": 1,
    "recipes": 1,
    "protocols": 1,
    "grades": 1,
    "schedule": 1,
    "paper": 1,
    "camera": 2,
    "splats": 2,
    "triangles": 2,
    "sh": 2,
    "geometry": 2,
    "images": 2,
    "exposure": 5,
    "data": 3,
    "io": 3,
    "kernels": 4,
    "render": 4,
    "losses": 5,
    "train": 6,
    "evaluate": 6,
    "sfm": 6,
    "mesh": 6,
    "report": 6,
    "view": 6,
    "page": 6,
    "pipeline": 7,
    "cli": 8,
}
PEERS = {
    ("recipes", "recipe"),
    ("protocols", "recipe"),
    ("schedule", "recipe"),
    ("paper", "recipes"),
    ("check", "errors"),
    ("disk", "errors"),
    ("geometry", "camera"),
    ("images", "camera"),
    ("data", "io"),
    ("render", "kernels"),
}
# Inside render: api > backend > the rasterizers > types.
RENDER = {
    "api": 4,
    "backend": 3,
    "cpu_cached": 3,
    "camera_gradient": 3,
    "cpu": 2,
    "cuda": 2,
    "cuda_passes": 1,
    "cuda_budget": 0,
    "reference_errors": 2,
    "reference": 1,
    "projection_reference": 0,
    "types": -1,
}


def unit(module: str) -> str:
    """``gs2d.render.api`` -> ``render``; "" for the package itself. ``cli_options`` belongs to ``cli``."""
    parts = module.split(".")
    name = parts[1] if len(parts) > 1 else ""
    return name if name in FLOORS or not name else name.split("_")[0]


def module_of(path: Path) -> str:
    parts = ["gs2d", *path.relative_to(PACKAGE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path: Path) -> list[str]:
    """Every gs2d module that a file imports, lazily or not; typing-only imports count too."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write the full name"
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return [name for name in found if name == "gs2d" or name.startswith("gs2d.")]


MODULES = {module_of(path): path for path in FILES}


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_imports_only_go_down(path: Path) -> None:
    here = module_of(path)
    own = unit(here)
    if own == "":
        return  # gs2d/__init__.py exports lazily from every floor
    assert own in FLOORS, f"{here}: give the new unit {own!r} a floor in docs/architecture.md and here"
    for imported in imports_of(path):
        other = unit(imported)
        if other in ("", own, "__version__"):
            continue
        assert other in FLOORS, f"{here} imports {imported}, which has no floor"
        downwards = FLOORS[other] < FLOORS[own]
        assert downwards or (own, other) in PEERS, f"{here} (floor {FLOORS[own]}) imports {imported}"


def module_meant(imported: str) -> str:
    """Return the module of an imported name: ``gs2d.io.ply`` of ``gs2d.io.ply.read_splats``."""
    parts = imported.split(".")
    if len(parts) == 2 and parts[1] in gs2d._HOME:  # what gs2d exports is of the module that it is from
        return gs2d._HOME[parts[1]]
    beginnings = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next(name for name in beginnings if name in MODULES)


def import_graph() -> dict[str, set[str]]:
    """Return what each module imports: at its top, inside functions, and for type checkers only.

    A package's ``__init__`` is a module like others: ``from gs2d.data import Scene`` is an edge to it, and it has edges
    to the modules that it exports from; ``from gs2d.data.scene import Scene`` is no edge to it. That of gs2d itself
    exports lazily from every floor, so that its own imports do not count.
    """
    graph = {module: {module_meant(name) for name in imports_of(path)} for module, path in MODULES.items()}
    return graph | {"gs2d": set()}


def test_no_module_imports_itself_by_way_of_others() -> None:
    graph = import_graph()
    assert "gs2d.pipeline.train" in graph["gs2d.pipeline.sweep"], "an import inside a function counts too"
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"a circle: {' is imported by '.join(error.args[1])}; move what they share into a module below")


def test_inside_render_the_api_is_on_top() -> None:
    for path in sorted((PACKAGE / "render").glob("*.py")):
        if path.stem == "__init__":
            continue
        for imported in imports_of(path):
            parts = imported.split(".")
            if parts[1] == "render":
                for name in parts[2:3] if parts[2] in RENDER else []:
                    assert RENDER[name] < RENDER[path.stem], f"render.{path.stem} imports render.{name}"


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_files_have_one_subject_and_no_more_lines_than_that_takes(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MAX_LINES


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_only_the_command_line_prints(path: Path) -> None:
    if unit(module_of(path)) == "cli":
        return
    calls = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    prints = [call.lineno for call in calls if isinstance(call.func, ast.Name) and call.func.id == "print"]
    assert not prints, f"print at lines {prints}"


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_no_bare_or_silent_except(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ExceptHandler):
            assert node.type is not None, f"bare except at line {node.lineno}"
            broad = isinstance(node.type, ast.Name) and node.type.id in ("Exception", "BaseException")
            silent = all(isinstance(statement, ast.Pass) for statement in node.body)
            assert not (broad and silent), f"silent except at line {node.lineno}"


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_declared_names_exist(path: Path) -> None:
    module = importlib.import_module(module_of(path))
    names = getattr(module, "__all__", [])
    assert len(names) == len(set(names))
    for name in names:
        assert hasattr(module, name), f"{module.__name__}.__all__ names {name!r}"


def test_the_package_exports_exactly_what_can_be_imported() -> None:
    """__all__, the lazy table, the names for type checkers and dir() are one list."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    checked = next(node for node in tree.body if isinstance(node, ast.If))
    for_checkers = {alias.name for node in checked.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert set(gs2d.__all__) == set(gs2d._HOME) | {"__version__"} == for_checkers | {"__version__"} == set(dir(gs2d))
    for name in gs2d.__all__:
        assert getattr(gs2d, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        gs2d.nothing  # noqa: B018


def run_python(code: str) -> None:
    """Run in a fresh interpreter, which must succeed."""
    environment = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("module", ["", ".errors", ".check", ".recipe", ".recipes", ".protocols", ".schedule"])
def test_recipes_and_protocols_import_without_torch(module: str) -> None:
    code = f"import sys, gs2d{module}; assert 'torch' not in sys.modules, 'torch was imported'"
    run_python(code)


def test_importing_a_module_has_no_side_effect_on_torch() -> None:
    modules = [module_of(path) for path in FILES if unit(module_of(path)) not in ("cli", "")]
    code = (
        "import importlib, torch\n"
        "before = (torch.get_default_dtype(), torch.initial_seed(), torch.get_num_threads(), torch.is_grad_enabled())\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
        "after = (torch.get_default_dtype(), torch.initial_seed(), torch.get_num_threads(), torch.is_grad_enabled())\n"
        "assert before == after, (before, after)\n"
    )
    run_python(code)


FORBIDDEN = {"plyfile", "pymeshlab", "open3d", "torchvision", "numba", "cv2", "trimesh", "skimage", "torchmetrics"}


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_only_the_declared_dependencies_are_imported(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        for name in names:
            assert name.split(".")[0] not in FORBIDDEN, f"{module_of(path)} imports {name}"


def test_test_files_have_names_of_their_own() -> None:
    """pytest imports them by their bare names: of two that share one the second is an error."""
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert len(names) == len(set(names)), sorted(name for name in set(names) if names.count(name) > 1)
