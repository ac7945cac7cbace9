"""``report.html``: the result of a run in one file that opens offline.

The first screen shows verdict and images; the sections below it are folded. Everything is read from the run folder.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from markupsafe import Markup

from gs2d.core.atomic_files import atomic_write
from gs2d.io.run_dir import REPORT
from gs2d.report.first_screen import first_screen
from gs2d.report.html_parts import macro, missing, page
from gs2d.report.part_guard import Guard, OnFailure
from gs2d.report.run_record import RunRecord, read_record
from gs2d.report.sections.section_registry import SECTIONS, Section


def write_report(run: Path, *, on_failure: OnFailure | None = None) -> Path:
    """Write ``report.html`` into a run folder, and return its path.

    Raise RunError if the folder is not a run, DataError if ``run.json``, ``metrics.json`` or ``events.jsonl`` is
    broken, DiskError if the report cannot be written. ``run``: a run folder, finished or not. ``on_failure``: receives
    the name and the error of each part that fails; the report shows the error in its place.
    """
    record, guard = read_record(run), Guard(on_failure)
    body = [first_screen(record, guard), *_sections(record, guard)]
    target = record.path / REPORT
    with atomic_write(target, "w") as file:
        file.write(page(f"{record.title}: gs2d report", body))
    return target


def _sections(record: RunRecord, guard: Guard) -> list[str]:
    """Return the sections that are not empty, folded."""
    folded: list[str] = []
    for name, section in SECTIONS.working():
        html = guard(f"section {name}", partial(_html, section, record))
        if html:
            shown = html if isinstance(html, Markup) else missing(html)
            folded.append(macro("macros.html", "folded", name, getattr(section, "title", name), shown))
    return folded


def _html(section: Section, record: RunRecord) -> Markup:
    """Return the HTML of a section; may be empty."""
    return Markup(section(record) or "")
