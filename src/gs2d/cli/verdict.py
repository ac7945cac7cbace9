"""The verdict of a run as a few lines for a terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

WIDTH = 60  # columns: half of a small screen
_NAMES = 14  # columns of the names of findings
_GRADES = 8


def verdict_lines(verdict: Mapping[str, Any], width: int = WIDTH) -> list[str]:
    """Return a verdict (that of ``verdict.json``) in lines of at most ``width`` columns."""
    grade = verdict["grade"]
    lines = textwrap.wrap(f"Verdict: {str(grade or 'none').upper()}. {verdict['headline']}", width)
    for finding in verdict["findings"]:
        start = f"  {finding['grade'] or '-':<{_GRADES - 1}} {finding['name']:<{_NAMES - 1}} "
        lines += textwrap.wrap(finding["figure"], width, initial_indent=start, subsequent_indent=" " * len(start))
    advice = [finding["advice"] for finding in verdict["findings"] if finding["advice"]]
    if advice:
        lines.append("What to do next:")
    for text in advice:
        lines += textwrap.wrap(text, width, initial_indent="- ", subsequent_indent="  ")
    return lines
