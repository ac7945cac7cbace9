"""Learned vignetting and response of the cameras, from ``photometry.json``."""

from __future__ import annotations

from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.io.run_dir import PHOTOMETRY
from gs2d.report.html import missing, render
from gs2d.report.record import RunRecord
from gs2d.report.sections.registry import register_section


@register_section("photometry", title="Vignetting and response of the cameras")
def photometry_section(run: RunRecord) -> str | None:
    """Return one line per camera; None where the recipe learns neither."""
    if not run.recipe.get("photometry"):
        return None
    path = run.path / PHOTOMETRY
    if not path.exists():
        return missing(f"{path.name} is missing: it is written when training is finished.")
    try:
        cameras = [
            {
                "photographs": len(entry["photographs"]),
                "first": str(entry["photographs"][0]),
                "corner": float(entry["corner"]),
                "shift": float(entry["shift"]),
            }
            for entry in read_json(path)["cameras"]
        ]
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path} must hold falloff and shift of each camera, got another entry ({error})") from error
    return render("photometry.html", cameras=cameras)
