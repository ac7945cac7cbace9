"""Actions of the commands blocks and sweep."""

from __future__ import annotations

import json

from gs2d.cli.console import Console
from gs2d.cli.handlers import show_run
from gs2d.contrib.lab.blocks import blocks
from gs2d.contrib.lab.lab_commands import BlocksCommand, SweepCommand
from gs2d.contrib.lab.paper import PaperResult
from gs2d.contrib.lab.paper import paper as run_paper
from gs2d.contrib.lab.render import TITLES, claim_text, parts_of
from gs2d.errors import RunError


def show_blocks(command: BlocksCommand, console: Console) -> None:
    """Run ``gs2d blocks``."""
    run = blocks(command, console.on_event)
    show_run(run, console)


def show_table(command: SweepCommand, console: Console) -> None:
    """Run ``gs2d sweep``; RunError at the end, if runs failed."""
    result = run_paper(command, console.on_event)
    _tables(result, console)
    if command.json:
        files = {path.name: str(path) for path in result.files}
        claims = [claim.to_json() for claim in result.checked]
        rows = json.loads(result.files[0].read_text(encoding="utf-8"))
        console.result({"rows": rows, "claims": claims, "failures": result.failures, "files": files})
    if result.failures:
        name, reason = next(iter(result.failures.items()))
        more = (
            f" (and {len(result.failures) - 1} more, in {command.out / 'about.json'})"
            if len(result.failures) > 1
            else ""
        )
        raise RunError(
            f"{len(result.failures)} of the runs failed; the table lacks their figures: "
            f"{name}: {reason}{more}; fix that and run the command again"
        )


def _tables(result: PaperResult, console: Console) -> None:
    for part in parts_of(result.table, result.results):
        if part.trained:
            heads = ["", *(TITLES[metric] for metric in part.columns)]
            rows = [[row.name, *(figure.measured for figure in row.figures)] for row in part.rows if not row.quoted]
            console.table(f"{result.table.title}: {part.data_set}", heads, rows)
    for claim in result.checked:
        console.say(f"{claim.holds:>7}  {claim.text} ({claim.data_set}): {claim_text(claim)}")
    if result.unfinished:
        console.say(f"{result.unfinished} runs are not trained yet")
    for path in result.files:
        console.say(str(path))
