"""Table cells and rows without training, and a short schedule for trained ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from gs2d.contrib.lab.aggregate import FIGURES, Cell, Row
from gs2d.contrib.lab.paper_tables import TNT

TINY = ["--schedule-scale", "0.0005", "--set", "init_points=100", "--set", "surface.densify.max_splats=150"]


def make_cell(scene: str = "a", seed: int = 0, data_set: str = TNT, **figures: float | None) -> Cell:
    valid = {**dict.fromkeys(FIGURES), **figures}
    reasons = {name: "because" for name, value in valid.items() if value is None}
    return Cell(scene, data_set, seed, valid, reasons, Path("run"))


def make_row(name: str, *cells: Cell, paper: Mapping[str, Any] | None = None) -> Row:
    return Row(name, "2dgs", dict(paper or {}), "", cells)


def draw_nothing(patch: pytest.MonkeyPatch) -> None:
    """Disable reports: drawing takes seconds and is tested elsewhere."""
    patch.setattr("gs2d.pipeline.finish.run_report.report_run", lambda path, *_: path)
