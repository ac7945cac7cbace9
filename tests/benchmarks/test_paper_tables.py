"""benchmarks/paper_tables.py shortens what `gs2d paper` writes, and loses no table of it."""

from __future__ import annotations

from benchmarks import paper_tables

from gs2d.experiments.aggregate import Results, check_claims
from gs2d.experiments.render import to_markdown
from gs2d.experiments.tables import NERF_SYNTHETIC, PAPER_TABLES, TNT
from paper_cells import make_cell, make_row

ROWS = {"(I)": 30.0, "(II)": 31.0, "(III)": 30.9, "(IV)": 30.5}


def page() -> str:
    """Write the table of modules of one scene of a data set that is here, one that has no name of ours, none of TnT."""
    table = PAPER_TABLES["modules"]
    rows = tuple(
        make_row(
            name,
            *(make_cell("lego", data_set=where, psnr=psnr) for where in (NERF_SYNTHETIC, "other (new)")),
            paper={TNT: {"psnr": 24.0}},
        )
        for name, psnr in ROWS.items()
    )
    results = Results(rows)
    return to_markdown(table, results, check_claims(table, results), ["half the schedule"], ["gs2d train"])


def test_tables_of_what_was_trained_and_known_orders_stay_and_nothing_else() -> None:
    lines = paper_tables.shorten(page())
    assert [line for line in lines if line.endswith(":")] == ["Lego:", "other (new):"]
    assert sum(line.startswith("| (I) |") for line in lines) == 2
    orders = [line for line in lines if line.startswith("- ")]
    assert orders[0].startswith("- **no** (Lego): PSNR I < IV < II < III.")
    text = "\n".join(lines)
    assert not any(word in text for word in ("unknown", "24.0", "half the schedule", "gs2d train"))
    assert max(map(len, lines)) <= 120
