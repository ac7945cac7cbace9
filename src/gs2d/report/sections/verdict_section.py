"""The measures behind the verdict, and advice."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gs2d.core.json_files import read_json
from gs2d.io.run_dir import VERDICT
from gs2d.report.html_parts import render
from gs2d.report.run_record import RunRecord, reading
from gs2d.report.sections.section_registry import register_section


def read_verdict(run: Path) -> Mapping[str, Any] | None:
    """Return the verdict in ``verdict.json`` of a run folder, or None where there is none.

    Raises
    ------
    DataError
        If the file is broken.
    """
    path = run / VERDICT
    if not path.exists():
        return None
    with reading(path):
        verdict: Mapping[str, Any] = read_json(path)["verdict"]
        for finding in verdict["findings"]:
            finding.get("advice")
        return verdict


@register_section("verdict", title="Verdict")
def verdict_section(run: RunRecord) -> str | None:
    """Return the findings and the advice."""
    verdict = read_verdict(run.path)
    with reading(run.path / VERDICT):
        return None if verdict is None else render("verdict.html", verdict=verdict)
