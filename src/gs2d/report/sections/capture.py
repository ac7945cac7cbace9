"""The report about the cameras of photographs: how many have a place, why others have none, which lens was taken."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gs2d.core.images import read_image
from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.report.html import escape, image_tag, missing, table

CAPTURE = "capture"  # in a run of `gs2d reconstruct`
POSES_JSON, POSES_PNG = "poses.json", "poses.png"  # of a capture that `gs2d poses` made
WIDTH = 1100  # px of the picture of cameras and points


def capture_section(run: Path, definition: Mapping[str, Any]) -> str:
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
        return ""
    found = read_json(folder / POSES_JSON)
    try:
        rows = found["photographs"]
        lost = [row for row in rows if not row["placed"]]
        lead = (
            f"<p>{found['placed']} of {found['count']} photographs have a place; {found['points']:,} points, each seen "
            f"by {found['photos_per_point']:.1f} of them, {found['mean_error_px']:.2f} px off in the mean.</p>"
        )
        cameras = "".join(f"<p>{escape(camera['about'])}.</p>" for camera in found["cameras"][:4])
        about = str((found.get("lens") or {}).get("about", ""))
        reasons = [[escape(row["source"]), f"{int(row['features']):,}", escape(row["reason"])] for row in lost]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            f"{folder / POSES_JSON} must be as `gs2d poses` writes it, got another entry ({error})"
        ) from error
    lens = f"<p>{escape(about[:1].upper() + about[1:])}.</p>" if about else ""
    without = (
        "<h3>Photographs without a place</h3>" + table(["Photograph", "Features", "Why"], reasons, texts=(2,))
        if lost
        else ""
    )
    return "<h2>The cameras</h2>" + lead + cameras + lens + _image(folder / POSES_PNG) + without


def _image(path: Path) -> str:
    try:
        image = read_image(path)[:, :, :3]
    except DataError as error:
        return missing(f"{POSES_PNG} does not show: {error}")
    text = "Cameras (red) and points, from above and from the side"
    return image_tag(image, text, alt=text, width=WIDTH)
