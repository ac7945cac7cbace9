"""Cells and rows of a paper table that nothing was trained for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gs2d.paper_tables import TNT
from gs2d.pipeline.paper_rows import FIGURES, Cell, Row


def make_cell(scene: str = "a", seed: int = 0, data_set: str = TNT, **figures: float | None) -> Cell:
    known = {**dict.fromkeys(FIGURES), **figures}
    reasons = {name: "because" for name, value in known.items() if value is None}
    return Cell(scene, data_set, seed, known, reasons, Path("run"))


def make_row(name: str, *cells: Cell, paper: Mapping[str, Any] | None = None) -> Row:
    return Row(name, "2dgs", dict(paper or {}), "", cells)
