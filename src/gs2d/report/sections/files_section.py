"""The files of a run: links, purpose and size."""

from __future__ import annotations

from gs2d.io.run_dir import EVENTS, LEARNED, MESH, METRICS, PAGE, POSES, RUN_JSON, SPLATS, TEXTURED
from gs2d.report.html_parts import macro
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.section_registry import register_section

FILES = {  # the most useful first
    PAGE: "the splats as a page for any browser",
    MESH: "the mesh with vertex colours, for MeshLab, Blender and CloudCompare",
    TEXTURED: "the mesh with a texture, for Windows, macOS, Blender and the web",
    SPLATS: "the splats, as 2DGS PLY",
    METRICS: "all scores",
    RUN_JSON: "settings, machine and versions",
    EVENTS: "training log",
    LEARNED: "learned exposure",
    POSES: "refined cameras",
}


@register_section("files", title="Files")
def files_section(run: RunRecord) -> str | None:
    """Return links to the files that exist."""
    files = [(name, words, run.path / name) for name, words in FILES.items() if (run.path / name).is_file()]
    if not files:
        return None
    return macro("lists.html", "files", [(name, words, size_text(path.stat().st_size)) for name, words, path in files])


def size_text(count: int) -> str:
    """Return a number of bytes with its unit, to three significant digits at most."""
    for unit, step in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= step:
            return f"{count / step:.3g} {unit}" if count < 999.5 * step else f"{count / step:.0f} {unit}"
    return f"{count} bytes"
