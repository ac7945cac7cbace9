"""The measures behind the verdict, and advice."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import UndefinedError

from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.io.run_dir import VERDICT
from gs2d.report.html_parts import render
from gs2d.report.run_record import RunRecord
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
    data = read_json(path)
    verdict = data.get("verdict") if isinstance(data, Mapping) else None
    findings = verdict.get("findings") if isinstance(verdict, Mapping) else None
    if not isinstance(verdict, Mapping) or not isinstance(findings, list):
        raise DataError(f"{path} must hold a verdict as gs2d writes it, got something else")
    if not all(isinstance(finding, Mapping) for finding in findings):
        raise DataError(f"{path} must hold findings as gs2d writes them, got something else")
    return verdict


@register_section("verdict", title="Verdict")
def verdict_section(run: RunRecord) -> str | None:
    """Return the findings as a table, then the advice."""
    verdict = read_verdict(run.path)
    try:
        return None if verdict is None else render("verdict.html", verdict=verdict)
    except (TypeError, ValueError, UndefinedError) as error:
        raise DataError(f"{run.path / VERDICT} must hold a verdict as gs2d writes it: {error}") from error
