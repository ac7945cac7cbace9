"""Write the splats of a run or a file in another format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gs2d.core.splats import Splats
from gs2d.errors import RunError
from gs2d.io.formats.splat_formats import LAYOUTS, endings, layout_of, read_splats, write_layout, written_bytes
from gs2d.io.gaussians import Warn
from gs2d.io.run_dir import MESH, open_run
from gs2d.pipeline.prepare.loaded import checked_output, finished_splats


def export_run(path: Path, out: Path, layout: str | None = None) -> dict[str, Any]:
    """Write the splats of a run, or of a file of flat splats, in another format.

    ``layout`` is a name in ``io.formats.splat_formats.LAYOUTS``; None: by the ending of ``out``.
    """
    path, out = Path(path), Path(out)
    layout = checked_layout(path, out, layout)
    notes: list[str] = []
    splats = splats_of(path, notes.append)
    notes += write_layout(out, splats, layout)
    size = written_bytes(out, layout)
    return {"file": str(out), "splats": len(splats), "bytes": size, "layout": layout, "notes": notes}


def checked_layout(path: Path, out: Path, layout: str | None = None) -> str:
    """Return the layout of the splat file ``out`` that is written from the run or file ``path``.

    Raises RunError if there is no such layout, ``out`` has another ending, or is a file that must not be replaced.
    """
    layout = layout or layout_of(out)
    if layout is None:
        raise RunError(
            f"--out must end in {', '.join(endings()).replace('/', '')}, got {out} (meshes are written by `gs2d mesh "
            "RUN`: .ply, with --texture .glb or .obj)"
        )
    if layout not in LAYOUTS:
        raise RunError(LAYOUTS.unknown(layout))
    checked_output(path, out, LAYOUTS.get(layout).ending, f"layout {layout}")
    if out.resolve() in ((path / MESH).resolve(), path.resolve()):
        raise RunError(f"--out {out} is the mesh of the run or the input file; choose another name")
    return layout


def splats_of(path: Path, warn: Warn) -> Splats:
    """Return the splats of a finished run or of a file of flat splats; ``warn`` receives notes of the reader."""
    if path.is_file():
        return read_splats(path, warn)
    run = open_run(path)
    run.sweep()
    return finished_splats(run)
