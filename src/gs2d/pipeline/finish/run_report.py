"""Write the report of a run."""

from __future__ import annotations

from pathlib import Path

from gs2d.io.run_dir import PAGE, REPORT, RunFolder, open_run
from gs2d.pipeline.attempts import attempted_file, reason_of, remade_by
from gs2d.pipeline.look.page import page_run
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.training.events import NotMade, OnEvent, ignore


def report_run(path: Path, on_event: OnEvent = ignore) -> Path:
    """Write the report of a run; a section that fails is replaced by the reason, with a ``NotMade`` event."""
    from gs2d.report.report_page import write_report

    run = open_run(Path(path))
    run.sweep()

    def failed(section: str, error: Exception) -> None:
        on_event(NotMade(f"{section} in {REPORT}", reason_of(error), remade_by(run, REPORT), error))

    return write_report(run.path, on_failure=failed)


def report_again(run: RunFolder, on_event: OnEvent) -> None:
    """Write the report again after a change; report failures as events."""
    with attempted_file(run, REPORT, on_event):
        report_run(run.path, on_event)


def show_again(run: RunFolder, on_event: OnEvent, trained: Trained | None = None) -> None:
    """Write the report again after a change, and the page, if there is one; report failures as events."""
    if run.file(PAGE).exists():
        with attempted_file(run, PAGE, on_event):
            page_run(run.path, on_event=on_event, trained=trained)
    report_again(run, on_event)
