"""The verdict of a run as a few lines for a terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gs2d.cli.console import Console

WIDTH = 60  # columns: half of a small screen
_NAMES = 14  # columns of the names of findings
_GRADES = 8


def say_verdict(path: Path, console: Console) -> dict[str, Any]:
    """Print the verdict of a run; return it for the JSON, null where there is none."""
    from gs2d.io.run_dir import RunFolder
    from gs2d.pipeline.finish.run_verdict import read_verdict

    verdict = read_verdict(RunFolder(path))
    for line in verdict_lines(verdict) if verdict is not None else ():
        console.say(line)
    return {"verdict": verdict}


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
