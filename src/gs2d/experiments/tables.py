"""The tables of the 2DGS-R paper as data: rows in the paper's order, the recipe of each, and the paper's own figures.

Rows without a recipe are quoted: other methods, which this project does not train. What the paper says a table shows
is here too, as :class:`Order` values that can be checked against any rows. A table of recipes that somebody chose
(:func:`recipe_table`) has neither figures of the paper nor orders. Pure Python; never imports torch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from gs2d.config.presets import TABLES

SWEEP = "sweep"  # the name of a table of chosen recipes
TNT, NERF_SYNTHETIC, DTU = "TnT", "NeRF-Synthetic", "DTU"  # the data sets, as they are called in every result
# Which way is better, and how many digits the paper prints.
METRICS: Mapping[str, str] = MappingProxyType(
    {"fscore": "F-score", "chamfer": "Chamfer", "psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS"}
)
LOWER_IS_BETTER = frozenset({"chamfer", "lpips", "bytes", "seconds"})


@dataclass(frozen=True)
class Order:
    """Something the paper says a table shows, in a form that rows can be checked against.

    Attributes
    ----------
    text : str
        The claim in words.
    metric : str
        A key of METRICS, or "surface": F-score, or the Chamfer distance (smaller is better) where that is the data
        set's figure.
    rows : tuple of str
        Labels: from worst to best ("ascending"), the best last ("best"), or all alike ("flat").
    kind : str
    within : float or None
        For "flat": largest difference between any two rows. It is a little more than the paper's own.
    """

    text: str
    metric: str
    rows: tuple[str, ...]
    kind: str = "ascending"
    within: float | None = None


@dataclass(frozen=True)
class PaperRow:
    """A row.

    Attributes
    ----------
    name : str
    recipe : str or None
        None: quoted only.
    paper : data set -> metric -> figure
        What the paper prints; what it does not print is absent.
    note : str
    """

    name: str
    recipe: str | None
    paper: Mapping[str, Mapping[str, float]]
    note: str = ""


@dataclass(frozen=True)
class PaperTable:
    """A table.

    Attributes
    ----------
    name, title : str
    label : str
        Its LaTeX label (in the paper).
    columns : data set -> metrics, in the paper's order
    rows : tuple of PaperRow
    orders : tuple of Order
    """

    name: str
    title: str
    label: str
    columns: Mapping[str, tuple[str, ...]]
    rows: tuple[PaperRow, ...]
    orders: tuple[Order, ...]

    @property
    def trained(self) -> tuple[PaperRow, ...]:
        """The rows that have a recipe."""
        return tuple(row for row in self.rows if row.recipe is not None)

    @property
    def of_paper(self) -> bool:
        """Whether it is the paper's; else its rows are compared with each other only."""
        return self.name != SWEEP

    @property
    def command(self) -> str:
        """What makes it."""
        return f"gs2d paper {self.name}" if self.of_paper else "gs2d sweep"


def recipe_table(recipes: Sequence[str]) -> PaperTable:
    """A table with a row for each recipe, named as it is, and nothing of the paper."""
    nothing: Mapping[str, Any] = MappingProxyType({})
    rows = tuple(PaperRow(name, name, nothing) for name in dict.fromkeys(recipes))
    return PaperTable(SWEEP, "Recipes compared", "tab:sweep", nothing, rows, ())


_IMAGE = ("psnr", "ssim", "lpips")
_ALL = ("fscore", *_IMAGE)
_BOTH = ("fscore", "psnr")
_THREE = {TNT: _ALL, NERF_SYNTHETIC: _ALL, DTU: ("chamfer", *_IMAGE)}

# One line a row: label | figures of each data set, "-" where the paper prints none.
_REGULARISATION = """
alpha=0 beta=0         | 24.54 0.838 0.200 0.15
alpha=100/10 beta=0    | 23.56 0.817 0.225 0.14
alpha=100/10 beta=0.05 | 23.08 0.809 0.235 0.32
alpha=0 beta=0.05      | 24.30 0.836 0.203 0.33
alpha=0 beta=0.1       | 24.07 0.832 0.207 0.36
alpha=0 beta=0.3       | 22.74 0.804 0.243 0.32
"""
_BENCHMARK = """
NeuS          | 0.38 24.58 -     -     | -     -     -     -     | 0.84 31.97 0.840 -
3DGS          | -    -     -     -     | -     -     -     -     | 4.03 32.91 0.943 0.092
SuGaR         | -    -     -     -     | -     -     -     -     | 1.24 32.76 0.942 0.094
GSDF          | -    -     -     -     | -     -     -     -     | 0.80 33.65 0.948 0.092
GOF           | 0.46 23.06 0.845 0.177 | 0.908 33.28 0.969 0.031 | 0.75 35.11 0.949 0.130
PGSR          | 0.40 23.79 0.851 0.160 | 0.907 31.84 0.964 0.036 | 0.56 33.78 0.945 0.147
SVRaster      | 0.40 23.04 -     0.144 | -     -     -     -     | -    -     -     -
2DGS          | 0.33 24.30 0.836 0.203 | 0.905 31.89 0.965 0.038 | 0.77 34.78 0.939 0.165
2DGS (w/o NC) | 0.15 24.54 0.838 0.200 | 0.874 33.06 0.968 0.033 | 1.40 35.54 0.941 0.163
2DGS-R        | 0.33 24.73 0.841 0.197 | 0.911 32.92 0.967 0.034 | 0.74 35.69 0.943 0.159
2DGS (60k)    | -    -     -     -     | -     -     -     -     | -    -     -     -
"""
_K = """
K=1  | 0.33 24.73 0.841 0.197
K=3  | 0.33 24.70 0.841 0.197
K=5  | 0.33 24.71 0.841 0.196
K=10 | 0.33 24.72 0.841 0.195
K=30 | 0.33 24.75 0.842 0.193
K=50 | 0.34 24.78 0.843 0.191
"""
_FREEZE = """
(,)         | 0.33 24.61 0.840 0.198
(alpha,SHs) | 0.33 24.52 0.838 0.201
(SHs)       | 0.33 24.50 0.837 0.201
(alpha)     | 0.33 24.73 0.841 0.197
"""
_MODULES = """
(I)   | 0.33 24.30
(II)  | 0.24 24.84
(III) | 0.26 24.89
(IV)  | 0.33 24.73
"""
_ABSGS = """
2DGS (w/o NC)    | 0.15 24.54 | 0.874 33.06 | 1.40 35.54
2DGS (w NC)      | 0.33 24.30 | 0.905 31.89 | 0.77 34.78
2DGS-R (AbsGS-D) | 0.19 23.19 | 0.899 32.53 | 0.95 33.53
2DGS-R (AbsGS-A) | 0.08 24.26 | 0.904 33.15 | 0.90 34.57
2DGS-R (ours)    | 0.33 24.73 | 0.911 32.92 | 0.74 35.69
"""
_NOTES = {
    "GOF": "re-run by the paper's authors",
    "PGSR": "re-run by the paper's authors, voxel size of 2DGS; PGSR itself prints F 0.52",
    "2DGS": "re-run by the paper's authors",
    "2DGS (60k)": "control, not in the paper: 2DGS for as many iterations as 2DGS-R",
}


def _table(
    name: str,
    title: str,
    label: str,
    columns: Mapping[str, tuple[str, ...]],
    text: str,
    orders: tuple[Order, ...],
) -> PaperTable:
    """Parse the figures; the recipe of a row is that of ``recipes.TABLES``."""
    rows = []
    for line in text.strip().splitlines():
        row, *groups = (part.strip() for part in line.split("|"))
        paper: dict[str, Mapping[str, float]] = {}
        for (data_set, metrics), group in zip(columns.items(), groups, strict=True):
            figures = dict(zip(metrics, group.split(), strict=True))
            paper[data_set] = MappingProxyType({m: float(value) for m, value in figures.items() if value != "-"})
        rows.append(PaperRow(row, TABLES[name].get(row), MappingProxyType(paper), _NOTES.get(row, "")))
    return PaperTable(name, title, label, MappingProxyType(dict(columns)), tuple(rows), orders)


_BETAS = ("alpha=0 beta=0.3", "alpha=0 beta=0.1", "alpha=0 beta=0.05", "alpha=0 beta=0")
_FREEZES = ("(SHs)", "(alpha,SHs)", "(,)", "(alpha)")
_KS = tuple(TABLES["k"])

PAPER_TABLES: Mapping[str, PaperTable] = MappingProxyType(
    {
        table.name: table
        for table in (
            _table(
                "regularisation",
                "The effect of the regularisation terms (alpha: distortion, beta: normal consistency)",
                "tab:alpha_beta",
                {TNT: (*_IMAGE, "fscore")},
                _REGULARISATION,
                (
                    Order("normal consistency costs PSNR, the more the heavier", "psnr", _BETAS),
                    Order("normal consistency makes the surface", "surface", (_BETAS[3], _BETAS[2])),
                    Order(
                        "the surface is best at beta 0.1: too much of it harms",
                        "surface",
                        (*_BETAS[::2], _BETAS[1]),
                        "best",
                    ),
                    Order(
                        "distortion leaves the surface as it is",
                        "surface",
                        ("alpha=0 beta=0.05", "alpha=100/10 beta=0.05"),
                        "flat",
                        0.02,
                    ),
                    Order("distortion costs PSNR", "psnr", ("alpha=100/10 beta=0.05", "alpha=0 beta=0.05")),
                ),
            ),
            _table(
                "benchmark",
                "Quantitative comparison on three data sets",
                "tab:benchmark",
                _THREE,
                _BENCHMARK,
                (
                    Order("2DGS-R has a better PSNR than 2DGS", "psnr", ("2DGS", "2DGS-R")),
                    Order("normal consistency costs PSNR", "psnr", ("2DGS", "2DGS (w/o NC)")),
                    Order("normal consistency makes the surface", "surface", ("2DGS (w/o NC)", "2DGS")),
                    Order("2DGS-R keeps the surface of 2DGS", "surface", ("2DGS", "2DGS-R"), "at least"),
                ),
            ),
            _table(
                "k",
                "Ablation of K, the percentage of splats that count as high-error",
                "tab:ablation_K",
                {TNT: _ALL},
                _K,
                (
                    Order("PSNR does not depend on K", "psnr", _KS, "flat", 0.1),
                    Order("nor does the surface", "surface", _KS, "flat", 0.02),
                ),
            ),
            _table(
                "freeze",
                "What stage 3 freezes; the rest is fine-tuned",
                "tab:ablation_freeze",
                {TNT: _ALL},
                _FREEZE,
                (
                    Order("frozen opacity is best", "psnr", _FREEZES, "best"),
                    Order("frozen colours cost PSNR", "psnr", ("(SHs)", "(,)")),
                    Order("the surface does not depend on what is frozen", "surface", _FREEZES, "flat", 0.02),
                ),
            ),
            _table(
                "modules",
                "Modules: in-place clone, frozen opacity, normal consistency resumed",
                "tab:ab_module",
                {TNT: _BOTH},
                _MODULES,
                (
                    Order("PSNR I < IV < II < III", "psnr", ("(I)", "(IV)", "(II)", "(III)")),
                    Order("freezing opacity moves PSNR by 0.05 dB only", "psnr", ("(II)", "(III)"), "flat", 0.1),
                    Order("surface II < III < IV", "surface", ("(II)", "(III)", "(IV)")),
                    Order("with all three the surface is that of 2DGS", "surface", ("(I)", "(IV)"), "at least"),
                ),
            ),
            _table(
                "absgs",
                "AbsGS densification in place of the in-place clone",
                "tab:absgs",
                {TNT: _BOTH, NERF_SYNTHETIC: _BOTH, DTU: ("chamfer", "psnr")},
                _ABSGS,
                (
                    Order(
                        "tuned thresholds (A) have a better PSNR than AbsGS's own (D)",
                        "psnr",
                        ("2DGS-R (AbsGS-D)", "2DGS-R (AbsGS-A)"),
                    ),
                    Order("the clone has a better PSNR than AbsGS-D", "psnr", ("2DGS-R (AbsGS-D)", "2DGS-R (ours)")),
                    Order(
                        "AbsGS harms the surface",
                        "surface",
                        ("2DGS-R (AbsGS-A)", "2DGS-R (AbsGS-D)", "2DGS-R (ours)"),
                        "best",
                    ),
                ),
            ),
        )
    }
)


def printed(metric: str, data_set: str, figure: float) -> str:
    """A figure of the paper with the digits that it prints."""
    digits = {"psnr": 2, "chamfer": 2, "fscore": 2 if data_set == TNT else 3}.get(metric, 3)
    return f"{figure:.{digits}f}"
