"""The first screen of the report: verdict, rendering against photograph, mesh, three numbers, the next command."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from gs2d.core.text import duration
from gs2d.io.run_dir import MESH, RENDERS
from gs2d.report.gallery import Gallery, compared, read_gallery
from gs2d.report.html_parts import Pair, render
from gs2d.report.mesh_view import MeshView, mesh_view
from gs2d.report.part_guard import Guard
from gs2d.report.run_record import RunRecord, number
from gs2d.report.sections.verdict_section import read_verdict


def first_screen(run: RunRecord, guard: Guard) -> str:
    """Return the first screen; a part that fails is replaced by its error."""
    verdict = guard("verdict", lambda: read_verdict(run.path))
    loaded = guard("gallery", lambda: read_gallery(run.path / RENDERS))
    gallery = loaded if isinstance(loaded, Gallery) else None
    cameras = [] if gallery is None else [view.camera for view in gallery.views]
    pair = loaded if isinstance(loaded, str) else guard("comparison with a photograph", lambda: _pair(gallery))
    mesh = guard("view of the mesh", lambda: mesh_view(run.path, cameras))
    fields = verdict if isinstance(verdict, Mapping) else {}
    return render(
        "first_screen.html",
        title=run.title,
        grade=fields.get("grade"),
        sentence=verdict if isinstance(verdict, str) else _sentence(run, fields),
        advice=next((str(entry["advice"]) for entry in fields.get("findings", ()) if entry.get("advice")), ""),
        pair=pair if isinstance(pair, Pair) else None,
        no_pair=pair if isinstance(pair, str) else None,
        mesh=mesh if isinstance(mesh, MeshView) else None,
        no_mesh=mesh if isinstance(mesh, str) else None,
        numbers=_numbers(run),
        command=_next_command(run),
    )


def _sentence(run: RunRecord, verdict: Mapping[str, Any]) -> str:
    """Return the verdict in one sentence."""
    if run.unfinished:
        return f"Training is not finished: {', '.join(run.unfinished)} missing."
    return str(verdict.get("headline", "The result was not scored."))


def _pair(gallery: Gallery | None) -> Pair | str:
    """Return the first view beside its photograph, or the reason why there is none."""
    pair = compared(gallery, gallery.views[0], width=1000) if gallery is not None and gallery.views else None
    return "There is no rendering yet. `gs2d render RUN` writes some." if pair is None else pair


def _numbers(run: RunRecord) -> list[tuple[str, str]]:
    """Return up to three figures of the run with their names."""
    figures = []
    psnr, splats = number((run.last.get(run.split) or {}).get("psnr")), number(run.last.get("splats"))
    if psnr is not None:
        figures.append((f"{psnr:.1f} dB", "PSNR on new views" if run.split == "test" else "PSNR on training views"))
    if splats is not None:
        size = number(run.last.get("bytes"))
        figures.append((f"{splats:,.0f}", "splats" + ("" if size is None else f", {size / 1e6:.1f} MB")))
    seconds = [number(stage.get("seconds")) for stage in run.stages]
    if seconds and all(value is not None for value in seconds):
        figures.append((duration(sum(value or 0.0 for value in seconds)), "training"))
    return figures


def _next_command(run: RunRecord) -> str:
    """Return the most likely next command."""
    path = shlex.quote(str(run.path))
    return f"gs2d view {path}" if (run.path / MESH).is_file() else f"gs2d mesh {path}"
