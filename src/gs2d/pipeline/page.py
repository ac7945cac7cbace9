"""``gs2d page``: the splats of a run, or of a file, as one file for any browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.missing import where_it_ends
from gs2d.core.transforms import up_direction
from gs2d.data import View
from gs2d.data.subject import Subject, read_subject
from gs2d.errors import DataError, RunError
from gs2d.io.formats.registry import read_splats
from gs2d.io.run_dir import PAGE, is_run, open_run
from gs2d.pipeline.events import Notice, OnEvent, Phase, ignore
from gs2d.pipeline.finished import finished_splats
from gs2d.pipeline.job import Job, reload_job
from gs2d.pipeline.view import frame_around, from_aside, settings_without_run, world_of
from gs2d.viewer.web import Seen, write_page

MAX_VIEWS = 100  # photographs that one can step through
SUFFIXES = (".html", ".htm")
LARGE = 50_000_000  # bytes, from which phones take long, and mail refuses


def page_run(
    path: Path,
    out: Path | None = None,
    *,
    sh_degree: int = 3,
    on_event: OnEvent = ignore,
    job: Job | None = None,
) -> dict[str, Any]:
    """Write the page of a run or of a file of splats.

    Parameters
    ----------
    path : Path
    out : Path or None
        None: ``scene.html`` in the run, or beside the file.
    sh_degree : int
        0 to 3: how much of the colours' dependence on the direction is stored.
    on_event : callable
    job : Job or None
        What defines the run, where it is at hand; None: it is read.

    Returns
    -------
    dict
        ``file``, ``splats``, ``sh_degree``, ``views``, ``bytes``.
    """
    path = Path(path)
    of_run = path.is_dir() or is_run(path)
    out = (path / PAGE if of_run else path.with_suffix(".html")) if out is None else Path(out)
    if out.suffix.lower() not in SUFFIXES:
        raise RunError(f"--out must name an .html file, which is what is written, got {out}")
    if not 0 <= sh_degree <= 3:
        raise RunError(f"--sh-degree must be 0, 1, 2 or 3, got {sh_degree}")
    if of_run:
        run = open_run(path)
        run.sweep()
        splats = finished_splats(run)
        definition = run.definition()
        title = definition.get("title") or definition["scene"]["name"]
        try:
            job = job or reload_job(run, on_event)
        except (RunError, DataError) as error:
            on_event(Notice(f"without the cameras of the photographs: {error}"))
    else:
        if not path.exists():
            raise DataError(f"expected a run folder or a file of splats at {path}, found nothing{where_it_ends(path)}")
        splats, title = read_splats(path, lambda text: on_event(Notice(text))), path.stem
    views = [] if job is None else _some(job.scene.train)
    cameras = [view.camera for view in views]
    frame = frame_around(cameras, splats.means.cpu().numpy())
    subject = _subject(path, on_event) if of_run and cameras else None
    up = up_direction(cameras) if cameras else np.array([0.0, 0.0, 1.0])
    seen = [Seen(view.name, view.camera) for view in views] or [Seen("from aside", from_aside(frame, up))]
    settings = settings_without_run(splats) if job is None else job.settings
    on_event(Phase("writing the page", 0))
    written = write_page(
        *(out, splats, seen, settings),
        title=title,
        focus=frame.origin,
        unit=frame.unit,
        up=up,
        sh_degree=sh_degree,
        subject=subject,
        world=world_of(path, on_event),
    )
    if written["bytes"] > LARGE:
        on_event(Notice(f"{written['bytes'] / 1e6:.0f} MB are much for a page: --sh-degree 1 or 0 makes it smaller"))
    return {"file": str(out), "views": len(seen), **written}


def _subject(folder: Path, on_event: OnEvent) -> Subject | None:
    """Return what the run says that it is about; None where it says nothing, or its file is damaged, which is told."""
    try:
        return read_subject(folder)
    except DataError as error:
        on_event(Notice(f"the page opens at what the cameras look at: {error}"))
        return None


def _some(views: tuple[View, ...]) -> list[View]:
    """At most so many, evenly."""
    count = min(len(views), MAX_VIEWS)
    return [views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int)]
