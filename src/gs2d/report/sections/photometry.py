"""The vignetting and the response of the cameras in the report: what a run's ``photometry.json`` says, in words."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup

from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.report.html import missing, render


def photometry_section(path: Path) -> Markup:
    """Table (HTML) of the cameras of ``photometry.json``, which may be missing."""
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
