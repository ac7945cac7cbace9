"""Structure from motion: photographs with a camera, their lenses, photographs without a camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gs2d.core.json_files import read_json
from gs2d.data.image_files import read_image
from gs2d.errors import DataError
from gs2d.report.html_parts import render
from gs2d.report.run_record import RunRecord, reading
from gs2d.report.sections.section_registry import register_section

CAPTURE = "capture"  # folder in a run of `gs2d reconstruct`
POSES_JSON, POSES_PNG = "poses.json", "poses.png"  # files in a capture of `gs2d poses`


@register_section("capture", title="Cameras")
def capture_section(run: RunRecord) -> str | None:
    """Return the result of structure from motion; None for captures with cameras from other programs."""
    folders = (run.path / CAPTURE, Path(run.definition["scene"]["path"]))
    folder = next((folder for folder in folders if (folder / POSES_JSON).is_file()), None)
    if folder is None:
        return None
    pixels, unreadable = _image(folder / POSES_PNG)
    with reading(folder / POSES_JSON):
        poses = read_json(folder / POSES_JSON)
        rows = [row for row in poses["photographs"] if not row["placed"]]
        lost = [(row["source"], f"{int(row['features']):,}", row["reason"]) for row in rows]
        return render("capture.html", poses=poses, lost=lost, pixels=pixels, unreadable=unreadable)


def _image(path: Path) -> tuple[np.ndarray | None, str]:
    """Return the image, or the reason why there is none."""
    try:
        return read_image(path)[:, :, :3], ""
    except DataError as error:
        return None, str(error)
