"""The files of a run in its report: relative links, what each is for, and how large it is."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup

from gs2d.io.run_dir import EVENTS, EXPOSURE, MESH, METRICS, PAGE, PHOTOMETRY, POSES, RUN_JSON, SPLATS, TEXTURED
from gs2d.report.html import macro, missing

FILES = {  # in the order in which people want them
    PAGE: "the scene to turn, in any browser",
    MESH: "the surface with colours, for MeshLab, Blender, CloudCompare",
    TEXTURED: "the surface with a texture, for Windows, macOS, Blender, the web",
    SPLATS: "the splats; gs2d export makes other formats of it",
    METRICS: "all figures",
    RUN_JSON: "what was run, and on which machine",
    EVENTS: "the log of the training",
    EXPOSURE: "the exposure of each photograph",
    POSES: "the corrected cameras",
    PHOTOMETRY: "the vignetting and the response of each camera",
}


def links(folder: Path) -> Markup:
    """Return links (HTML) to those of a run's files that exist."""
    found = [(name, words) for name, words in FILES.items() if (folder / name).is_file()]
    if not found:
        return missing("There are no files beside this report.")
    sized = [(name, words, size_text((folder / name).stat().st_size)) for name, words in found]
    return macro("lists.html", "files", sized)


def size_text(count: int) -> str:
    """Return bytes in words: 3 significant digits at most."""
    for unit, step in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= step:
            return f"{count / step:.3g} {unit}" if count < 999.5 * step else f"{count / step:.0f} {unit}"
    return f"{count} bytes"
