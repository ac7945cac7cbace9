"""Make the tables of docs/notebook/paper-tables.md: run `gs2d sweep` for every paper table and capture group.

::

    python -m benchmarks.paper_tables --data CAPTURES --out runs/paper [--tables modules k] [--groups bottle-lego]
        [--set slots=2] [--seeds 3]

``CAPTURES`` holds the captures under the names of ``GROUPS``. `gs2d sweep` writes full pages with the paper's figures,
the deviations and every command. This script prints a summary in the page's format: a table per capture, and which of
the paper's rankings are reproduced. Finished runs are kept, so an interrupted command can be restarted.
"""

from __future__ import annotations

import argparse
import textwrap
from dataclasses import dataclass
from pathlib import Path

from benchmarks.results import execute

TABLES = ("modules", "freeze", "k", "benchmark", "absgs", "regularisation")
SCALE = "0.1"


@dataclass(frozen=True)
class Group:
    """Captures of one table, small enough for two cores."""

    name: str
    scenes: tuple[str, ...]
    downscale: int


GROUPS = (
    Group("bottle-lego", ("rendered_bottle", "nerf_synthetic_lego"), downscale=2),
    Group("scan24", ("dtu_scan24",), downscale=8),
    Group("fox", ("fox_instant_ngp",), downscale=4),
)
CALLED = {  # name in `gs2d sweep` -> name here
    "other (nerf-synthetic)": "Bottle",
    "NeRF-Synthetic": "Lego",
    "DTU": "DTU scan 24 (training views)",
    "other (generic)": "Fox",
}


def make_table(table: str, group: Group, args: argparse.Namespace) -> str:
    """Run `gs2d sweep` and return its Markdown."""
    out = args.out / f"{group.name}-{table}"
    words = ["gs2d", "sweep", table, "--data", str(args.data), "--scenes", *group.scenes, "--out", str(out)]
    words += ["--set", f"cache={args.out / 'cache'}", "--schedule-scale", SCALE, "--downscale", str(group.downscale)]
    words += ["--seeds", str(args.seeds), *(["--set", f"slots={args.slots}"] if args.slots else [])]
    execute(words)
    return (out / "table.md").read_text()


def shorten(page: str) -> list[str]:
    """Return the lines to compare: the tables of trained runs, and the rankings that could be evaluated."""
    lines = []
    for section in page.split("\n## ")[1:]:
        title, _, text = section.partition("\n")
        if title.startswith(("The paper's figures", "How this differs", "Commands")):
            continue
        if not title.startswith("Do the paper's claims"):
            lines += [f"{CALLED.get(title, title)}:", "", *text.strip().splitlines(), ""]
        else:
            told = [line for line in text.strip().splitlines() if not line.startswith("- **unknown**")]
            for line in told:
                for name, ours in CALLED.items():
                    line = line.replace(f"({name}):", f"({ours.split(' (')[0]}):")
                lines += textwrap.wrap(line, 120, subsequent_indent="  ", break_on_hyphens=False)
    return lines


def main() -> None:
    """Run missing experiments and print the tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("runs/paper"))
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--groups", nargs="+", choices=[group.name for group in GROUPS], default=["bottle-lego"])
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds")
    parser.add_argument("--slots", type=int, default=0, help="number of parallel runs")
    args = parser.parse_args()
    for group in (group for group in GROUPS if group.name in args.groups):
        pages: list[str] = []
        for table in args.tables:
            pages += [f"## {table}: {group.name}", "", *shorten(make_table(table, group, args)), ""]
            (args.out / f"tables-{group.name}.md").write_text("\n".join(pages))
        print("\n".join(pages))


if __name__ == "__main__":
    main()
