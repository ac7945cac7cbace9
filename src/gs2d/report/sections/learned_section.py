"""Learned quantities of photographs and cameras: their reports, with a plot by photograph."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from gs2d.config.quantities import QUANTITIES
from gs2d.core.json_files import read_json
from gs2d.io.run_dir import LEARNED, POSES
from gs2d.report.html_parts import render
from gs2d.report.plots import lines_by_image
from gs2d.report.run_record import RunRecord, name_of, reading
from gs2d.report.sections.section_registry import register_section


@register_section("learned", title="Learned quantities")
def learned_section(run: RunRecord) -> str | None:
    """Return the report of each learned quantity of the recipe; None if nothing was learned."""
    record: dict[str, Any] = {"views": {}, "frames": []}
    for file in filter(lambda file: (run.path / file).is_file(), (LEARNED, POSES)):
        with reading(run.path / file):
            data = read_json(run.path / file)
            record |= {key: data[key] for key in record.keys() & data.keys()}
    parts = [_part(run, name, record) for name in map(name_of, run.recipe.get("learned") or ())]
    return Markup("\n").join(filter(None, parts)) if any(parts) else None


def _part(run: RunRecord, name: str, record: Mapping[str, Any]) -> Markup | None:
    if name not in QUANTITIES:
        text = f"The package that adds this quantity is not installed; {LEARNED} has its numbers."
        return render("learned.html", title=name, text=text, plot=None)
    quantity = QUANTITIES.get(name)
    with reading(run.path / LEARNED):
        result = quantity.report(name, record)
    if result is None:
        return None
    plot = lines_by_image(result.curves) if result.curves else None
    return render("learned.html", title=quantity.title or name, text=result.text, plot=plot)
