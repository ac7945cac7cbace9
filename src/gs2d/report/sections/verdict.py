"""The verdict in the report: its first section, from ``verdict.json``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jinja2 import UndefinedError
from markupsafe import Markup

from gs2d.config.grades import LIMITS, NEW, TRAINED
from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.report.html import render


def verdict_section(path: Path) -> Markup:
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
        return Markup()
    try:
        data = read_json(path)["verdict"]
        return Markup() if data is None else render("verdict.html", verdict=data)
    except (KeyError, TypeError, ValueError, UndefinedError) as error:
        raise DataError(f"{path} must hold a verdict as gs2d writes it, got another entry ({error})") from error


def grade_of(psnr: float, split: str) -> str:
    """Return the grade of a mean PSNR."""
    return LIMITS[NEW if split == "test" else TRAINED].grade(psnr)


def scaled(value: Any, factor: float) -> float | None:
    """Return a figure in another unit; None for what is no number."""
    return value * factor if isinstance(value, int | float) else None
