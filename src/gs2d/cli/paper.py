"""``gs2d paper`` and ``gs2d sweep``: from arguments to options, and the table on the screen."""

from __future__ import annotations

import json

from gs2d.cli.commands import Paper, Sweep, TableCommon
from gs2d.cli.console import Console
from gs2d.errors import RecipeError, RunError
from gs2d.experiments.paper import PaperResult
from gs2d.experiments.paper import paper as run_paper
from gs2d.experiments.plan import PaperOptions
from gs2d.experiments.render import TITLES, parts_of, verdict_text
from gs2d.experiments.tables import SWEEP


def show_table(command: TableCommon, console: Console) -> None:
    """Run the command; what failed is an error at the end, when everything else is done and written.

    Raises
    ------
    RunError
        Some runs failed.
    """
    result = run_paper(paper_options(command), console.on_event)
    console.close()
    _tables(result, console)
    if command.json:
        files = {path.name: str(path) for path in result.files}
        orders = [verdict.to_json() for verdict in result.verdicts]
        rows = json.loads(result.files[0].read_text(encoding="utf-8"))
        console.result({"rows": rows, "orders": orders, "failures": result.failures, "files": files})
    if result.failures:
        name, reason = next(iter(result.failures.items()))
        more = (
            f" (and {len(result.failures) - 1} more, in {command.out / 'about.json'})"
            if len(result.failures) > 1
            else ""
        )
        raise RunError(
            f"{len(result.failures)} of the runs failed, the table is written without what they lack: "
            f"{name}: {reason}{more}; mend that and run the command again"
        )


def paper_options(command: TableCommon) -> PaperOptions:
    """Return the options of the pipeline.

    Raises
    ------
    RecipeError
    """
    return PaperOptions(
        table=command.table if isinstance(command, Paper) else SWEEP,
        recipes=_split(command.recipes) if isinstance(command, Sweep) else (),
        data=command.data,
        out=command.out,
        scenes=_split(command.scenes),
        protocol=command.protocol,
        backend=command.backend,
        schedule_scale=command.schedule_scale,
        downscale=command.downscale,
        seeds=parse_seeds(command.seeds),
        overrides=command.overrides,
        slots=command.slots,
        cache=command.cache,
        truth=command.truth,
        lpips_weights=command.lpips_weights,
        threads=command.threads,
        train=not command.no_train,
    )


def _split(words: tuple[str, ...]) -> tuple[str, ...]:
    """``a,b c`` and ``a b c`` alike."""
    return tuple(part for word in words for part in word.split(",") if part)


def parse_seeds(words: tuple[str, ...]) -> tuple[int, ...]:
    """``0,1,2`` or ``0 1 2`` are seeds; one number n > 0 is a count, the seeds 0 to n - 1.

    Raises
    ------
    RecipeError
    """
    parts = _split(words)
    if not parts or not all(part.isdecimal() for part in parts):
        raise RecipeError(
            f"--seeds must be whole numbers like 0,1,2, or a count like 3, got {' '.join(words) or 'nothing'}"
        )
    numbers = tuple(int(part) for part in parts)
    listed = len(numbers) > 1 or "," in words[0] or numbers == (0,)
    return numbers if listed else tuple(range(numbers[0]))


def _tables(result: PaperResult, console: Console) -> None:
    for part in parts_of(result.table, result.results):
        if part.trained:
            heads = ["", *(TITLES[metric] for metric in part.columns)]
            rows = [[row.name, *(figure.measured for figure in row.figures)] for row in part.rows if not row.quoted]
            console.table(f"{result.table.title}: {part.data_set}", heads, rows)
    for verdict in result.verdicts:
        console.say(f"{verdict.holds:>7}  {verdict.text} ({verdict.data_set}): {verdict_text(verdict)}")
    if result.unfinished:
        console.say(f"{result.unfinished} runs are not trained yet")
    for path in result.files:
        console.say(str(path))
