"""Report section on world coordinates: scale, position, and residuals of control points."""

from __future__ import annotations

from markupsafe import Markup

from gs2d.contrib.survey.georeference import CHECK, FITTED, LEFT_OUT, Residual, read_georeference
from gs2d.report.html_parts import macro
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.section_registry import register_section

SHOWN = 12  # residuals: check points first, then the largest
_ORDER = (CHECK, LEFT_OUT, FITTED)
_COLUMNS = ["Name", "Used as", "Error, m", "East", "North", "Up"]


@register_section("georeference", title="World coordinates")
def georeference_section(run: RunRecord) -> str | None:
    """Return the georeference and its largest residuals; None if the run has none."""
    world = read_georeference(run.path)
    if world is None:
        return None
    first, *lines = world.lines()
    html = Markup("<p>{}.</p><ul>{}</ul>").format(
        first[:1].upper() + first[1:], Markup().join(Markup("<li>{}</li>").format(line) for line in lines)
    )
    shown = sorted(world.residuals, key=lambda residual: (_ORDER.index(residual.role), -residual.distance))[:SHOWN]
    if shown:
        html += macro("macros.html", "table", _COLUMNS, [_row(residual) for residual in shown], texts=(0, 1))
    if rest := len(world.residuals) - len(shown):
        html += Markup("<p>{} more have smaller errors.</p>").format(rest)
    return html


def _row(residual: Residual) -> tuple[str, ...]:
    distance = f"{residual.distance:.3f}"
    return (residual.name, residual.role, distance, *(f"{part:+.3f}" for part in residual.error))
