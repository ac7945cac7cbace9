"""The report about the cameras of photographs: how many have a place, why others have none, which lens was taken."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import UndefinedError
from markupsafe import Markup

from gs2d.core.json_files import read_json
from gs2d.data.image_files import read_image
from gs2d.errors import DataError
from gs2d.report.html import render

CAPTURE = "capture"  # in a run of `gs2d reconstruct`
POSES_JSON, POSES_PNG = "poses.json", "poses.png"  # of a capture that `gs2d poses` made


def capture_section(run: Path, definition: Mapping[str, Any]) -> Markup:
    """Return what structure from motion found (HTML); empty for a capture whose cameras came from elsewhere.

    Parameters
    ----------
    run : Path
        The run's folder; of `gs2d reconstruct` it holds the capture.
    definition : mapping
        run.json.

    Raises
    ------
    DataError
        ``poses.json`` is broken.
    """
    scene = definition.get("scene")
    stated = Path(str(scene.get("path"))) if isinstance(scene, Mapping) and scene.get("path") else run
    folder = next((f for f in (run / CAPTURE, stated) if (f / POSES_JSON).is_file()), None)
    if folder is None:
        return Markup()
    found = read_json(folder / POSES_JSON)
    pixels, unreadable = _image(folder / POSES_PNG)
    try:
        rows = [row for row in found["photographs"] if not row["placed"]]
        lost = [(row["source"], f"{int(row['features']):,}", row["reason"]) for row in rows]
        lens = str((found.get("lens") or {}).get("about", ""))
        return render("capture.html", found=found, lens=lens, lost=lost, pixels=pixels, unreadable=unreadable)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError, UndefinedError) as error:
        raise DataError(
            f"{folder / POSES_JSON} must be as `gs2d poses` writes it, got another entry ({error})"
        ) from error


def _image(path: Path) -> tuple[np.ndarray | None, str]:
    """Return the picture, or why there is none."""
    try:
        return read_image(path)[:, :, :3], ""
    except DataError as error:
        return None, str(error)
