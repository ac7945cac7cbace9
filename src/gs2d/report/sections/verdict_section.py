"""The measures of the verdict, and advice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gs2d.core.json_files import read_json
from gs2d.io.run_dir import VERDICT
from gs2d.io.run_schema import VERDICT_SHAPE, check_shape
from gs2d.report.html_parts import render
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.section_registry import register_section


def read_verdict(run: Path) -> dict[str, Any] | None:
    """Return the verdict in ``verdict.json`` of a run folder, or None where there is none.

    Raise DataError or RunError if the file is broken.
    """
    path = run / VERDICT
    if not path.exists():
        return None
    data = read_json(path)
    check_shape(path, data, VERDICT_SHAPE, "delete it; `gs2d evaluate RUN` writes it again")
    verdict: dict[str, Any] = data["verdict"]
    return verdict


@register_section("verdict", title="Verdict")
def verdict_section(run: RunRecord) -> str | None:
    """Return the findings and the advice."""
    verdict = read_verdict(run.path)
    return None if verdict is None else render("verdict.html", verdict=verdict)
