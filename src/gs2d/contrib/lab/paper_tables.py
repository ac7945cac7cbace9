"""The tables of the 2DGS-R paper, from ``paper_tables.toml``, and tables of chosen recipes.

Rows without a recipe are quoted figures of other methods. The statements of the paper on its tables are
:class:`Claim` values, which are checked against measured rows. Pure Python; never imports torch.
"""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from types import MappingProxyType
from typing import Any

from gs2d.config.recipe_files import short_name
from gs2d.contrib.lab.lab_options import SWEEP
from gs2d.contrib.lab.paper_recipes import TABLES
from gs2d.errors import RecipeError

TNT, NERF_SYNTHETIC, DTU = "TnT", "NeRF-Synthetic", "DTU"  # names of data sets in results
METRICS: Mapping[str, str] = MappingProxyType(
    {"fscore": "F-score", "chamfer": "Chamfer", "psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS"}
)
LOWER_IS_BETTER = frozenset({"chamfer", "lpips", "bytes", "seconds"})


@dataclass(frozen=True)
class Claim:
    """A statement of the paper on a table that can be checked."""

    text: str  # the claim in words
    metric: str  # a key of METRICS, or "surface": F-score or Chamfer distance, by data set
    rows: tuple[str, ...]  # labels: from worst to best ("ascending"), the best last ("best"), or all alike ("flat")
    kind: str = "ascending"
    within: float | None = None  # for "flat": largest difference of two rows, slightly above that of the paper


@dataclass(frozen=True)
class PaperRow:
    """A row; quoted if ``recipe`` is None. ``paper`` has the figures of the paper by data set and metric."""

    name: str
    recipe: str | None
    paper: Mapping[str, Mapping[str, float]]
    note: str = ""


@dataclass(frozen=True)
class PaperTable:
    """A table; ``label`` is its LaTeX label in the paper, ``columns`` its metrics by data set."""

    name: str
    title: str
    label: str
    columns: Mapping[str, tuple[str, ...]]
    rows: tuple[PaperRow, ...]
    claims: tuple[Claim, ...] = ()

    @property
    def trained(self) -> tuple[PaperRow, ...]:
        """Return the rows with a recipe."""
        return tuple(row for row in self.rows if row.recipe is not None)

    @property
    def of_paper(self) -> bool:
        """Return whether the table is in the paper."""
        return self.name != SWEEP

    @property
    def command(self) -> str:
        """Return the command that makes the table."""
        return f"gs2d sweep {self.name}" if self.of_paper else "gs2d sweep"


def recipe_table(recipes: Sequence[str]) -> PaperTable:
    """Return a table with one row per recipe, named by its short name; RecipeError if two have the same."""
    names = list(dict.fromkeys(recipes))
    shown = [short_name(name) for name in names]
    for first, second in itertools.combinations(range(len(names)), 2):
        if shown[first] == shown[second]:
            raise RecipeError(
                f"each recipe of a sweep needs a name of its own, got {shown[first]!r} from {names[first]} and from "
                f"{names[second]}; rename one"
            )
    rows = tuple(PaperRow(row, name, {}) for row, name in zip(shown, names, strict=True))
    return PaperTable(SWEEP, "Recipes compared", "tab:sweep", {}, rows)


def _read(name: str, table: Mapping[str, Any], notes: Mapping[str, str]) -> PaperTable:
    """Return a table of the file."""
    columns = {data_set: tuple(metrics) for data_set, metrics in table["columns"].items()}
    rows = []
    for line in table["rows"].splitlines():
        row, *groups = (part.strip() for part in line.split("|"))
        paper = {}
        for (data_set, metrics), group in zip(columns.items(), groups, strict=True):
            figures = zip(metrics, group.split(), strict=True)
            paper[data_set] = {metric: float(figure) for metric, figure in figures if figure != "-"}
        rows.append(PaperRow(row, TABLES[name].get(row), paper, notes.get(row, "")))
    claims = tuple(Claim(**{**claim, "rows": tuple(claim["rows"])}) for claim in table["claims"])
    return PaperTable(name, table["title"], table["label"], columns, tuple(rows), claims)


_FILE = tomllib.loads((files("gs2d.contrib.lab") / "paper_tables.toml").read_text(encoding="utf-8"))
PAPER_TABLES: Mapping[str, PaperTable] = MappingProxyType(
    {name: _read(name, table, _FILE["notes"]) for name, table in _FILE["tables"].items()}
)


def printed(metric: str, data_set: str, figure: float) -> str:
    """Return a figure of the paper with its digits."""
    digits = {"psnr": 2, "chamfer": 2, "fscore": 2 if data_set == TNT else 3}.get(metric, 3)
    return f"{figure:.{digits}f}"
