"""Architecture rules: layers, file lengths, public names, and modules that import without torch."""

from __future__ import annotations

import ast
import functools
import graphlib
import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

import gs2d

PACKAGE = Path(gs2d.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
MAX_LINES = 700  # soft: a file is one thing that a reader looks for
MAX_PARAMETERS = 8

# Floors: a module imports from its own room or from a lower floor. Rooms of one floor do not import each other.
FLOORS = {
    "errors": 0,
    "config": 1,
    "core": 1,
    "io": 2,
    "kernels": 2,
    "data": 3,
    "render": 3,
    "losses": 4,
    "meshing": 4,
    "sfm": 4,
    "evaluation": 5,
    "report": 5,
    "training": 5,
    "viewer": 5,
    "pipeline": 6,
    "cli": 8,
    "contrib": 9,
}
TOP = {"__init__.py", "__main__.py", "errors.py"}  # nothing else lies loose
# Floors inside a room: a module imports from lower ones of its room only. A folder of a room is one entry.
INSIDE = {
    "core": {
        "checks growth locks extras memory memory_limit missing processes spill text": 0,
        "atomic_files image_arrays similarity": 1,
        "json_files camera mesh sh splats": 2,
        "transforms": 3,
    },
    "data": {
        "load subject_box": 11,
        "known_captures": 10,
        "readers": 8,
        "build": 7,
        "bounds": 6,
        "scene": 5,
        "prior_maps faces masks": 4,
        "cache exif file_names undistort": 3,
        "camera_models image_files positions": 2,
        "arrays": 1,
    },
    "losses": {
        "prior_terms": 3,
        "priors view_terms": 2,
        "base prior_formulas": 1,
        "formulas": 0,
    },
    "pipeline": {
        "in_memory reconstruct": 6,
        "train": 5,
        "finish": 4,
        "look": 3,
        "prepare": 2,
        "attempts": 1,
    },
    "render": {
        "tensor_api": 8,
        "api cpu_backend cuda_backend reference_backend": 7,
        "kernel_backend": 6,
        "backends": 5,
        "cpu_cached pose_gradient exposure_transform": 4,
        "cpu_passes cuda_step reference_contributors": 3,
        "cuda_passes reference_pairs": 2,
        "pair_budget whole_step cuda_works reference_projection": 1,
        "rays types": 0,
    },
    "training": {
        "trainer": 6,
        "cached_objective whole_steps": 5,
        "objective resumable": 4,
        "actions densify robust": 3,
        "learned optimizer parallel rows": 2,
        "state": 1,
        "events photographs start step_result targets": 0,
    },
}


def unit(module: str) -> str:
    """``gs2d.render.api`` -> ``render``; "" for the package itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


def module_of(path: Path) -> str:
    parts = ["gs2d", *path.relative_to(PACKAGE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in FILES}


@functools.cache
def nodes_of(module: str) -> list[ast.AST]:
    return list(ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))))


@functools.cache
def imports_of(module: str) -> list[str]:
    """Return every gs2d module that a module imports, lazily or not; typing-only imports count too."""
    found = []
    for node in nodes_of(module):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found += [f"{'.' * node.level}{node.module or ''}.{alias.name}" for alias in node.names]
    return [name for name in found if name == "gs2d" or name.startswith(("gs2d.", "."))]


def test_imports_only_go_down() -> None:
    assert set(map(unit, MODULES)) - {"", "__main__"} == set(FLOORS), "a package lacks its layer, or the reverse"
    wrong = []
    for module in MODULES:
        own = unit(module)
        if own in ("", "__main__"):
            continue  # gs2d/__init__.py exports lazily from every layer
        for imported in imports_of(module):
            other = unit(imported)
            if other not in ("", own, "__version__") and not FLOORS.get(other, 99) < FLOORS[own]:
                wrong.append(f"{module} imports {imported}")
            if imported.startswith("."):
                wrong.append(f"{module} imports {imported}: write the full name")
    assert not wrong


def test_contrib_uses_public_names_and_its_parts_do_not_import_each_other() -> None:
    """The layers forbid the core to import contrib: contrib is the highest layer."""
    wrong = []
    for module in MODULES:
        if unit(module) != "contrib":
            continue
        part = ".".join(module.split(".")[:3])
        for imported in imports_of(module):
            in_contrib = imported.startswith("gs2d.contrib")
            private = any(name.startswith("_") for name in imported.split("."))
            if private or (in_contrib and not imported.startswith(part)):
                wrong.append(f"{module} imports {imported}")
    assert not wrong


def module_meant(imported: str) -> str:
    """Return the module of an imported name: ``gs2d.io.splat_ply`` of ``gs2d.io.splat_ply.read_splats``."""
    parts = imported.split(".")
    if len(parts) == 2 and parts[1] in gs2d._HOME:  # what gs2d exports is of the module that it is from
        return gs2d._HOME[parts[1]]
    beginnings = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next(name for name in beginnings if name in MODULES)


def import_graph() -> dict[str, set[str]]:
    """Return the imports of each module: at its top, inside functions, and for type checkers only.

    A package's ``__init__`` is a module like others: ``from gs2d.data import Scene`` is an edge to it, and it has edges
    to the modules that it exports from; ``from gs2d.data.scene import Scene`` is no edge to it. That of gs2d itself
    exports lazily from every floor, so that its own imports do not count.
    """
    graph = {module: set(map(module_meant, imports_of(module))) for module in MODULES}
    return graph | {"gs2d": set()}


def test_imports_have_no_cycle() -> None:
    graph = import_graph()
    assert "gs2d.pipeline.train.train_run" in graph["gs2d.contrib.lab.training_task"], (
        "an import inside a function counts too"
    )
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"a circle: {' is imported by '.join(error.args[1])}; move what they share into a module below")


def test_every_module_belongs_to_a_package() -> None:
    assert {path.name for path in PACKAGE.glob("*.py")} == TOP


@pytest.mark.parametrize("room", INSIDE)
def test_imports_within_a_package_go_down(room: str) -> None:
    floors = {name: floor for names, floor in INSIDE[room].items() for name in names.split()}
    assert set(floors) == {
        path.stem for path in (PACKAGE / room).iterdir() if path.suffix == ".py" or path.is_dir()
    } - {
        "__init__",
        "__pycache__",
    }
    wrong = []
    for module in MODULES:
        if unit(module) != room or module == f"gs2d.{room}":
            continue
        own = module.split(".")[2]
        for imported in imports_of(module):
            other = imported.split(".")[2] if unit(imported) == room else own
            if other in floors and other != own and not floors[other] < floors[own]:
                wrong.append(f"{module} imports {imported}")
    assert not wrong


def test_only_render_distinguishes_backends() -> None:
    """Differences between devices belong into ``Backend``: no comparison with its name, no table by name."""

    def is_name(node: ast.AST) -> bool:
        return isinstance(node, ast.Attribute) and node.attr == "name" and "backend" in ast.unparse(node.value).lower()

    def asks(node: ast.AST) -> bool:
        if isinstance(node, ast.Compare):
            return any(map(is_name, [node.left, *node.comparators]))
        if isinstance(node, ast.Subscript):
            return is_name(node.slice)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "get":
            return any(map(is_name, node.args))
        return isinstance(node, ast.alias) and node.name.startswith(("gs2d.render.cuda_", "gs2d.render.pair_budget"))

    assert asks(ast.parse("job.backend.name == 'cpu'", mode="eval").body)
    outside = [module for module in MODULES if unit(module) != "render"]
    assert not lines_where(asks, outside)


def test_files_are_not_too_long() -> None:
    lines = {module: len(path.read_text(encoding="utf-8").splitlines()) for module, path in MODULES.items()}
    assert not {module: count for module, count in lines.items() if count > MAX_LINES}


def test_no_function_takes_more_than_eight_parameters() -> None:
    """Besides self and cls; ``*args`` and ``**kwargs`` count as one each."""

    def takes(node: ast.AST) -> int:
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            return 0
        a = node.args
        named = [arg.arg for arg in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
        return len(named) - (named[:1] in (["self"], ["cls"])) + (a.vararg is not None) + (a.kwarg is not None)

    assert lines_where(lambda node: takes(node) == MAX_PARAMETERS, MODULES)
    assert not lines_where(lambda node: takes(node) > MAX_PARAMETERS, MODULES)


def test_names_of_modules_and_classes_are_unique() -> None:
    classes = [(node.name, name) for name in MODULES for node in nodes_of(name) if isinstance(node, ast.ClassDef)]
    files = [(path.stem, name) for name, path in MODULES.items() if path.name != "__init__.py"]
    for kind in (classes, files):
        homes: dict[str, list[str]] = {}
        for name, module in kind:
            homes.setdefault(name, []).append(module)
        assert not {name: modules for name, modules in homes.items() if len(modules) > 1}


def lines_where(is_wrong: Callable[[ast.AST], bool], modules: Iterable[str]) -> list[str]:
    """Return MODULE:LINE of each violation."""
    return [f"{name}:{getattr(node, 'lineno', 0)}" for name in modules for node in nodes_of(name) if is_wrong(node)]


def test_only_the_command_line_prints() -> None:
    def prints(node: ast.AST) -> bool:
        return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"

    assert lines_where(prints, MODULES)
    assert not lines_where(prints, [module for module in MODULES if unit(module) != "cli"])


def test_no_bare_or_silent_except() -> None:
    def is_wrong(node: ast.AST) -> bool:
        if not isinstance(node, ast.ExceptHandler):
            return False
        broad = isinstance(node.type, ast.Name) and node.type.id in ("Exception", "BaseException")
        return node.type is None or (broad and all(isinstance(statement, ast.Pass) for statement in node.body))

    assert not lines_where(is_wrong, MODULES)


def test_declared_names_exist() -> None:
    for name in MODULES:
        module = importlib.import_module(name)
        names = getattr(module, "__all__", [])
        assert len(names) == len(set(names)), name
        assert not [each for each in names if not hasattr(module, each)], name


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


def test_recipes_and_protocols_import_without_torch() -> None:
    code = (
        "import importlib, sys\n"
        f"for name in {LIGHT!r}: importlib.import_module(name); assert 'torch' not in sys.modules, name\n"
    )
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


def test_tests_mirror_the_package() -> None:
    """Other folders: ``helpers`` is shared code, ``benchmarks`` and ``fuzz`` test code outside the package."""
    root = Path(__file__).parent
    folders = {path.parent.relative_to(root) for path in root.rglob("test_*.py")} - {
        *map(Path, ("benchmarks", "fuzz", "gpu"))
    }
    assert not [str(folder) for folder in sorted(folders) if not (PACKAGE / folder).is_dir()]
