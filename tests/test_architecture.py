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

# Floors: a module imports from its own room or from a lower floor. Rooms of one floor do not import each other.
FLOORS = {
    "errors": 0,
    "config": 1,
    "core": 1,
    "io": 2,
    "kernels": 2,
    "data": 3,
    "render": 3,
    "geo": 4,
    "losses": 4,
    "meshing": 4,
    "sfm": 4,
    "evaluation": 5,
    "report": 5,
    "synthetic": 5,
    "training": 5,
    "viewer": 5,
    "pipeline": 6,
    "experiments": 7,
    "cli": 8,
}
TOP = {"__init__.py", "__main__.py", "errors.py"}  # nothing else lies loose
# Floors inside a room: a module imports from lower ones of its room only. A folder of a room is one entry.
INSIDE = {
    "core": {
        "checks growth light locks extras memory memory_limit missing processes spill text": 0,
        "exr files float_tiff georeference similarity": 1,
        "arrays json_files camera images mesh photo_formats sh splats": 2,
        "exif photometry residual_lens transforms": 3,
    },
    "data": {
        "archive": 9,
        "load subject": 8,
        "benchmarks prepare prepare_worker": 7,
        "prepared": 6,
        "readers": 5,
        "build": 4,
        "bounds reach": 3,
        "scene": 2,
        "priors faces straighten masks": 1,
        "cache file_names undistort": 0,
    },
    "render": {
        "tensor_api": 7,
        "api": 6,
        "backends photometry": 5,
        "cpu_cached pose_gradient exposure": 4,
        "cpu cuda cuda_step reference_errors": 3,
        "cuda_passes photometry_native reference": 2,
        "pair_budget whole_step reference_projection reference_transmittance culling": 1,
        "pose_gradient_native exposure_native": 1,
        "types": 0,
    },
}


def unit(module: str) -> str:
    """``gs2d.render.api`` -> ``render``; "" for the package itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


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
    if own in ("", "__main__"):
        return  # gs2d/__init__.py exports lazily from every floor
    assert own in FLOORS, f"{here}: give the new room {own!r} a floor in docs/architecture.md and here"
    for imported in imports_of(path):
        other = unit(imported)
        if other in ("", own, "__version__"):
            continue
        assert other in FLOORS, f"{here} imports {imported}, which has no floor"
        assert FLOORS[other] < FLOORS[own], f"{here} (floor {FLOORS[own]}) imports {imported}"


def module_meant(imported: str) -> str:
    """Return the module of an imported name: ``gs2d.io.splat_ply`` of ``gs2d.io.splat_ply.read_splats``."""
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
    assert "gs2d.pipeline.train" in graph["gs2d.experiments.jobs"], "an import inside a function counts too"
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"a circle: {' is imported by '.join(error.args[1])}; move what they share into a module below")


def test_nothing_lies_loose_on_the_top_level() -> None:
    assert {path.name for path in PACKAGE.glob("*.py")} == TOP


@pytest.mark.parametrize("room", INSIDE)
def test_inside_a_room_imports_go_down_too(room: str) -> None:
    floors = {name: floor for names, floor in INSIDE[room].items() for name in names.split()}
    assert set(floors) == {
        path.stem for path in (PACKAGE / room).iterdir() if path.suffix == ".py" or path.is_dir()
    } - {
        "__init__",
        "__pycache__",
    }
    for module, path in MODULES.items():
        if unit(module) != room or module == f"gs2d.{room}":
            continue
        own = module.split(".")[2]
        for imported in imports_of(path):
            other = imported.split(".")[2] if unit(imported) == room else own
            if other in floors and other != own:
                assert floors[other] < floors[own], f"{module} imports {imported}"


@pytest.mark.parametrize("path", FILES, ids=module_of)
def test_outside_of_render_nothing_asks_which_backend_it_has(path: Path) -> None:
    """What differs between processors is the matter of ``Backend``: no comparison with its name, no table by it."""
    if unit(module_of(path)) == "render":
        return

    def is_name(node: ast.AST) -> bool:
        return isinstance(node, ast.Attribute) and node.attr == "name" and "backend" in ast.unparse(node.value).lower()

    where = module_of(path)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Compare):
            compared = any(map(is_name, [node.left, *node.comparators]))
            assert not compared, f"{where}: line {node.lineno} compares a backend's name"
        if isinstance(node, ast.Subscript):
            assert not is_name(node.slice), f"{where}: line {node.lineno} looks something up by a backend's name"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "get":
            assert not any(map(is_name, node.args)), f"{where}: line {node.lineno} looks up a backend's name"
        if isinstance(node, ast.alias):
            assert not node.name.startswith(("gs2d.render.cuda", "gs2d.render.pair_budget")), f"imports {node.name}"


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


LIGHT = ["gs2d", "gs2d.errors", "gs2d.core.checks", *(module for module in MODULES if unit(module) == "config")]


@pytest.mark.parametrize("module", LIGHT)
def test_recipes_and_protocols_import_without_torch(module: str) -> None:
    run_python(f"import sys, {module}; assert 'torch' not in sys.modules, 'torch was imported'")


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


def test_tests_lie_where_their_modules_lie() -> None:
    """``helpers`` is what they share, ``benchmarks`` and ``fuzz`` test what is beside the package, ``gpu`` a device."""
    root = Path(__file__).parent
    folders = {path.parent.relative_to(root) for path in root.rglob("test_*.py")} - {
        *map(Path, ("benchmarks", "fuzz", "gpu"))
    }
    assert not [str(folder) for folder in sorted(folders) if not (PACKAGE / folder).is_dir()]
