"""The paper's tables as data: transcribed without an error, in its order, and consistent with what the paper says."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from gs2d.config.presets import RECIPES
from gs2d.contrib.lab.aggregate import FIGURES, Cell, Results, Row, check_claims
from gs2d.contrib.lab.paper_recipes import TABLES
from gs2d.contrib.lab.paper_tables import DTU, NERF_SYNTHETIC, PAPER_TABLES, TNT, PaperTable, printed

# How the paper writes the labels of our rows, where it is not the same.
TEX_LABELS = {
    "SuGaR": "Sugar",
    "2DGS (w/o NC)": "2DGS(w/o NC)",
    "2DGS (w NC)": "2DGS(w NC)",
    "2DGS-R (AbsGS-D)": "2DGS-R(AbsGS-D)",
    "2DGS-R (AbsGS-A)": "2DGS-R(AbsGS-A)",
    "2DGS-R (ours)": "2DGS-R(ours)",
    "(,)": r"(,)/($\mu$,$\alpha$,$\Sigma$,SHs)",
    "(alpha,SHs)": r"($\alpha$,SHs)/($\mu$,$\alpha$,$\Sigma$)",
    "(SHs)": r"(SHs)/($\mu$,$\alpha$,$\Sigma$)",
    "(alpha)": r"($\alpha$)/($\mu$,$\alpha$,$\Sigma$,SHs)",
}


@pytest.fixture(scope="module")
def tex() -> str:
    """The paper's source: $GS2D_PAPER_TEX, or beside the repository; else skip."""
    named = os.environ.get("GS2D_PAPER_TEX")
    path = Path(named) if named else Path(__file__).resolve().parents[4] / "shared" / "paper" / "2dgs-r.tex"
    if not path.is_file():
        pytest.skip(f"no source of the paper at {path}; set GS2D_PAPER_TEX to it")
    return path.read_text()


def tex_rows(tex: str, label: str) -> list[list[str]]:
    """The rows with figures of the table with a label: cells without bold face and footnote marks."""
    end = tex.index(f"\\label{{{label}}}")
    body = tex[tex.rindex("\\begin{tabular}", 0, end) : end]
    rows = []
    for line in body.split(r"\\"):
        line = re.sub(r"\\textbf\{([^}]*)\}", r"\1", line.replace("\\hline", "").replace("\\textsuperscript{*}", ""))
        cells = [cell.strip() for cell in line.split("&")]
        if len(cells) > 1 and re.fullmatch(r"[\d.]+|--", cells[-1]):
            rows.append(cells)
    return rows


@pytest.mark.parametrize("name", PAPER_TABLES)
def test_every_figure_is_the_papers_and_rows_are_in_its_order(name: str, tex: str) -> None:
    table = PAPER_TABLES[name]
    found = tex_rows(tex, table.label)
    ours = [row for row in table.rows if any(row.paper.values())]
    width = sum(map(len, table.columns.values()))
    assert len(found) == len(ours) >= 4
    for row, cells in zip(ours, found, strict=True):
        label = TEX_LABELS.get(row.name, row.name)
        if name == "regularisation":
            label = " ".join(re.findall(r"=(\S+)", row.name))
        assert " ".join(cells[:-width]).replace(r" \cmark", "").replace(r" \xmark", "") == label
        figures = [row.paper[d].get(m) for d, metrics in table.columns.items() for m in metrics]
        assert figures == [None if cell == "--" else float(cell) for cell in cells[-width:]], row.name


def test_a_figure_is_printed_with_the_papers_digits() -> None:
    assert [printed("fscore", TNT, 0.3), printed("fscore", NERF_SYNTHETIC, 0.9), printed("psnr", DTU, 24.3)] == [
        "0.30",
        "0.900",
        "24.30",
    ]


@pytest.mark.parametrize("name", PAPER_TABLES)
def test_trained_rows_are_those_of_the_recipes(name: str) -> None:
    table = PAPER_TABLES[name]
    assert {row.name: row.recipe for row in table.trained} == dict(TABLES[name])
    assert all(row.recipe in RECIPES for row in table.trained)
    assert [row.name for row in table.trained] == list(TABLES[name])


def test_quoted_rows_have_no_recipe() -> None:
    rows = {row.name: row.recipe for row in PAPER_TABLES["benchmark"].rows}
    quoted = [name for name, recipe in rows.items() if recipe is None]
    assert quoted == ["NeuS", "3DGS", "SuGaR", "GSDF", "GOF", "PGSR", "SVRaster"]
    assert list(rows)[7:10] == ["2DGS", "2DGS (w/o NC)", "2DGS-R"]


def as_results(table: PaperTable) -> Results:
    """The paper's own figures, as if they had been measured on one scene of each data set."""
    rows = []
    for row in table.trained:
        cells = tuple(
            Cell("scene", data_set, 0, {**dict.fromkeys(FIGURES), **figures}, {}, Path())
            for data_set, figures in row.paper.items()
            if figures
        )
        rows.append(Row(row.name, row.recipe, {}, "", cells))
    return Results(tuple(rows))


@pytest.mark.parametrize("name", PAPER_TABLES)
def test_what_the_paper_says_holds_for_its_own_figures(name: str) -> None:
    checked = check_claims(PAPER_TABLES[name], as_results(PAPER_TABLES[name]))
    assert len(checked) == len(PAPER_TABLES[name].claims) * len(PAPER_TABLES[name].columns)
    assert {f"{v.data_set}: {v.text}": v.holds for v in checked if v.holds != "yes"} == {}
