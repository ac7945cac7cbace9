"""The report about where a run is in the world: scale, place, what was left out, and how far control points lie off."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup

from gs2d.core.georeference import CHECK, FITTED, LEFT_OUT, Residual
from gs2d.io.georeference import read_georeference
from gs2d.report.html import render

SHOWN = 12  # residuals: check points first, then the largest
_ORDER = (CHECK, LEFT_OUT, FITTED)


def georeference_section(run: Path) -> Markup:
    """Return what ``georeference.json`` of a run says (HTML); empty where it has none.

    Raises
    ------
    DataError
        The file is damaged.
    """
    found = read_georeference(run)
    if found is None:
        return Markup()
    first, *lines = found.lines()
    shown = sorted(found.residuals, key=lambda residual: (_ORDER.index(residual.role), -residual.distance))[:SHOWN]
    rest = len(found.residuals) - len(shown)
    return render("georeference.html", first=first, lines=lines, rows=[_row(residual) for residual in shown], rest=rest)


def _row(residual: Residual) -> tuple[str, ...]:
    east, north, up = residual.error
    return (residual.name, residual.role, f"{residual.distance:.3f}", *(f"{part:+.3f}" for part in (east, north, up)))
