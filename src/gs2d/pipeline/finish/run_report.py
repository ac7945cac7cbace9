"""Write the report of a run."""

from __future__ import annotations

from pathlib import Path

from gs2d.core.camera import Camera
from gs2d.io.run_dir import REPORT, RunFolder, open_run
from gs2d.pipeline.attempts import again, attempted, reason_of
from gs2d.pipeline.finish.run_images import shown_cameras
from gs2d.training.events import NotMade, OnEvent, ignore


def report_run(path: Path, on_event: OnEvent = ignore) -> Path:
    """Write the report of a run; a section that fails is replaced by the reason, with a ``NotMade`` event."""
    from gs2d.report.report_page import write_report

    run = open_run(Path(path))
    run.sweep()
    command = again("evaluate", run.path)

    def failed(section: str, error: Exception) -> None:
        on_event(NotMade(f"{section} in {REPORT}", reason_of(error), command, error))

    cameras: list[Camera] = []
    with attempted(f"cameras of the images in {REPORT}", command, on_event):
        cameras = shown_cameras(run)
    write_report(run.path, cameras=cameras, on_failure=failed)
    return run.file(REPORT)


def report_again(run: RunFolder, on_event: OnEvent) -> None:
    """Write the report again after a change; report failures as events."""
    with attempted(REPORT, again("evaluate", run.path), on_event):
        report_run(run.path, on_event)
