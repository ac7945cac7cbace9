"""The verdict in the report: its first section, from ``verdict.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gs2d.config.grades import GRADES, TEST_PSNR, TRAIN_PSNR
from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.report.html import escape, table


def verdict_section(path: Path) -> str:
    """Return grade, findings and advice (HTML); empty where there is no verdict.

    Parameters
    ----------
    path : Path
        ``verdict.json``.

    Raises
    ------
    DataError
        It is broken.
    """
    if not path.exists():
        return ""
    try:
        data = read_json(path)["verdict"]
        if data is None:
            return ""
        head = f'<p class="verdict">{badge(data["grade"])} {escape(data["headline"])}</p>'
        return f"<h2>Verdict</h2>{head}{_findings(data['findings'])}{_advice(data['findings'])}"
    except (KeyError, TypeError) as error:
        raise DataError(f"{path} must hold a verdict as gs2d writes it, got another entry ({error})") from error


def badge(grade: str | None) -> str:
    """A grade as a coloured word."""
    word = grade if grade in GRADES else None
    return f'<span class="grade {word or "none"}">{word or "not graded"}</span>'


def graded(psnr: float, split: str) -> str:
    """A mean PSNR (HTML) in the colour of its grade."""
    grade = (TEST_PSNR if split == "test" else TRAIN_PSNR).grade(psnr)
    return f'<b class="{grade}">{psnr:.2f} dB</b>'


def _findings(findings: Sequence[Mapping[str, Any]]) -> str:
    rows = [
        [escape(f["name"]), f"<td>{badge(f['grade'])}</td>", escape(f["figure"]), escape(f["text"])] for f in findings
    ]
    return table(["Finding", "Grade", "Figure", "What it says"], rows, texts=(3,))


def _advice(findings: Sequence[Mapping[str, Any]]) -> str:
    items = "".join(f"<li>{escape(f['advice'])}</li>" for f in findings if f["advice"])
    return f"<h3>What to do or to photograph next</h3><ul>{items}</ul>" if items else ""


def scaled(value: Any, factor: float) -> float | None:
    """A figure in another unit; None for what is no number."""
    return value * factor if isinstance(value, int | float) else None
