"""A failing image, mesh, report or page is reported and does not affect the other results."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import pytest

from ball_runs import failing, options
from gs2d.core.atomic_files import disk_error
from gs2d.errors import DiskError, ProtocolError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.attempts import attempted
from gs2d.pipeline.finish.run_report import report_run
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, NotMade

MADE = ("mesh.ply", "report.html", "scene.html")


@pytest.fixture
def finished(undisturbed: RunFolder, tmp_path: Path) -> Path:
    """A finished run whose last files are to be made again."""
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    for name in MADE:
        (copy / name).unlink()
    return copy


@pytest.mark.parametrize(
    ("place", "error", "what", "reason", "command"),
    [
        ("train.train_run.extract_mesh", ProtocolError("no depth"), "mesh.ply", "no depth", "gs2d mesh {run}"),
        ("train.train_run.extract_mesh", MemoryError("much"), "mesh.ply", "out of memory", "gs2d mesh {run}"),
        (
            "finish.run_report.report_run",
            OSError("broken data stream"),
            "report.html",
            "fault in gs2d: OSError: broken data stream",
            "gs2d evaluate {run}",
        ),
        (
            "train.train_run.page_run",
            ZeroDivisionError(),
            "scene.html",
            "fault in gs2d: ZeroDivisionError: no message",
            "gs2d export {run} --format html",
        ),
        (
            "train.run_logger.draw_stage",
            ValueError("x"),
            "images of stage refine",
            "fault in gs2d: ValueError: x",
            None,
        ),
    ],
)
def test_a_failing_result_is_reported_and_the_others_are_made(
    place: str,
    error: Exception,
    what: str,
    reason: str,
    command: str | None,
    capture: Path,
    finished: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(f"gs2d.pipeline.{place}", failing(error))
    heard: list[Event] = []
    train(options(capture, finished, resume=True), heard.append)
    missing = [event for event in heard if isinstance(event, NotMade)]
    assert [(event.what, event.reason) for event in missing] == [(what, reason)]
    assert missing[0].command == (command and command.format(run=finished))
    assert missing[0].error is error
    assert {name for name in MADE if (finished / name).exists()} == set(MADE) - {what}


def test_a_full_disk_ends_the_run(capture: Path, finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = disk_error(finished / "report.html", OSError(errno.ENOSPC, "No space left on device"))
    monkeypatch.setattr("gs2d.pipeline.finish.run_report.report_run", failing(full))
    with pytest.raises(DiskError, match="No space left"):
        train(options(capture, finished, resume=True))


@pytest.mark.parametrize("error", [KeyboardInterrupt(), BrokenPipeError(), OSError(errno.EDQUOT, "quota")])
def test_interrupts_closed_pipes_and_full_disks_are_raised(error: BaseException) -> None:
    heard: list[Event] = []
    with pytest.raises(type(error)), attempted("x", None, heard.append):
        raise error
    assert heard == []


def test_the_page_is_written_unless_disabled(capture: Path, finished: Path) -> None:
    train(options(capture, finished, resume=True, page=False))
    assert not (finished / "scene.html").exists()
    train(options(capture, finished, resume=True))
    page = (finished / "scene.html").read_bytes()
    assert b"<canvas" in page
    train(options(capture, finished, resume=True))
    assert (finished / "scene.html").read_bytes() == page


def test_a_failing_section_does_not_affect_others(
    undisturbed: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = Path(shutil.copytree(undisturbed.path, tmp_path / "run"))
    monkeypatch.setattr("gs2d.report.sections.training_section.curves", failing(RuntimeError("no curve today")))
    (copy / "renders" / "index.json").write_text("{")
    heard: list[Event] = []
    report_run(copy, heard.append)
    whats = [event.what for event in heard if isinstance(event, NotMade)]
    assert whats == ["gallery in report.html", "section views in report.html", "section training in report.html"]
    assert {event.command for event in heard if isinstance(event, NotMade)} == {f"gs2d evaluate {copy}"}
    text = (copy / "report.html").read_text()
    assert "The section training could not be made: no curve today" in text
    assert "Settings" in text
