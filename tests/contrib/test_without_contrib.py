"""The core works when the folder of contrib is deleted; the entry points of contrib name what is there."""

from __future__ import annotations

import importlib
import shutil
from pathlib import Path

import gs2d
from capture_writers import small_colmap
from cli_process import CliProcess
from gs2d.cli.commands import COMMANDS
from gs2d.config.presets import RECIPES
from gs2d.config.protocols import PROTOCOLS
from gs2d.config.registry import Registry, contrib_entries
from gs2d.data.known_captures import DATA_SETS
from gs2d.data.readers.capture_readers import READERS
from gs2d.evaluation.evaluators import EVALUATORS
from gs2d.io.formats.splat_formats import LAYOUTS, SPLAT_READERS
from gs2d.meshing.mesh_methods import MESH_METHODS
from gs2d.report.sections.section_registry import SECTIONS

SOURCE = Path(gs2d.__file__).parent
CONTRIB_USES: tuple[Registry, ...] = (
    *(COMMANDS, PROTOCOLS, RECIPES, DATA_SETS, READERS, EVALUATORS),
    *(LAYOUTS, SPLAT_READERS, SECTIONS, MESH_METHODS),
)


def test_every_entry_point_registers_its_name() -> None:
    """Names registered in contrib are exactly those of its entry points."""
    entries = {(entry.group, entry.name): entry.module for entry in contrib_entries()}
    assert len(entries) > 15
    by_group = {registry.group: registry for registry in CONTRIB_USES}
    for (group, name), module in entries.items():
        importlib.import_module(module)
        assert name in dict(by_group[group].working(by_group[group].builtin)), f"{group}: {name}"
        assert name not in by_group[group].guests()


def test_the_core_trains_and_exports_without_contrib(tmp_path: Path) -> None:
    site = tmp_path / "site"
    shutil.copytree(SOURCE, site / "gs2d", ignore=shutil.ignore_patterns("contrib", "__pycache__"))
    run = CliProcess(site)

    listed = run("--help").stdout
    assert "reconstruct" in listed
    assert "survey" not in listed
    assert "demo" not in listed
    capture = tmp_path / "ring"
    small_colmap(capture)
    few = (
        "--set",
        "init_points=60",
        "--schedule-scale",
        "0.0003",
        "--set",
        "page=false",
        "--recipe",
        "2dgs",
        "--robust",
        "off",
    )
    run("train", capture, "--out", tmp_path / "run", *few)
    run("export", tmp_path / "run", "--out", tmp_path / "a.ply")
    assert (tmp_path / "a.ply").stat().st_size > 1000
    assert "--out must end in .ply" in run("export", tmp_path / "run", "--out", tmp_path / "a.sog", code=2).stderr
    run.close()
