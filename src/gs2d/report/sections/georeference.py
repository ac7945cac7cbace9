"""World coordinates: scale, position, and residuals of control points."""

from __future__ import annotations

from gs2d.core.georeference import CHECK, FITTED, LEFT_OUT, Residual
from gs2d.io.georeference import read_georeference
from gs2d.report.html import render
from gs2d.report.record import RunRecord
from gs2d.report.sections.registry import register_section

SHOWN = 12  # residuals: check points first, then the largest
_ORDER = (CHECK, LEFT_OUT, FITTED)


@register_section("georeference", title="World coordinates")
def georeference_section(run: RunRecord) -> str | None:
    """Return the georeference and the largest residuals; None where the run has none."""
    found = read_georeference(run.path)
    if found is None:
        return None
    first, *lines = found.lines()
    shown = sorted(found.residuals, key=lambda residual: (_ORDER.index(residual.role), -residual.distance))[:SHOWN]
    rest = len(found.residuals) - len(shown)
    return render("georeference.html", first=first, lines=lines, rows=[_row(residual) for residual in shown], rest=rest)


def _row(residual: Residual) -> tuple[str, ...]:
    east, north, up = residual.error
    return (residual.name, residual.role, f"{residual.distance:.3f}", *(f"{part:+.3f}" for part in (east, north, up)))
