"""The table of real photographs: what is run and watched, what is read from it, and what is said of it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from benchmarks import street_runs
from benchmarks.street_runs import Process, watch_process
from PIL import Image


def process(command: list[str], exit_code: int = 0) -> Process:
    return Process(command, exit_code, 120.0, 90.0, 30.0, 10**9)


# -- a process -----------------------------------------------------------------------------------------------------
def test_a_process_is_watched_with_its_children_and_what_it_took_before_a_file_was_there(tmp_path: Path) -> None:
    burn = "import time; start = time.process_time()\nwhile time.process_time() < start + 0.4: pass\n"
    child = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {burn!r}], check=True)\n"
    made = tmp_path / "cameras"
    code = child + f"open({str(made)!r}, 'w')\nimport time; time.sleep(1.0)\n{burn}x = bytearray(60 << 20); sys.exit(3)"
    took = watch_process([sys.executable, "-c", code], tmp_path / "console.txt", when=made)
    assert took.exit_code == 3
    assert took.cpu_seconds >= 0.8
    assert took.cpu_seconds_before is not None
    assert 0.4 <= took.cpu_seconds_before <= took.cpu_seconds - 0.35
    assert took.seconds >= 1.0
    assert took.peak_rss_bytes > 60 << 20


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Commands that were started; each leaves a file in the run folder."""
    commands: list[list[str]] = []

    def watch(command: list[str], console: Path, **_: Any) -> Process:
        commands.append(list(command))
        run = Path(command[command.index("--out") + 1])
        assert not run.exists(), "a run that was cut off is begun anew"
        run.mkdir()
        console.write_text("")
        return process(list(command))

    monkeypatch.setattr(street_runs, "watch_process", watch)
    return commands


def test_photographs_alone_are_used_and_a_finished_run_is_not_repeated(
    tmp_path: Path, started: list[list[str]]
) -> None:
    source, folder = tmp_path / "data", tmp_path / "draft" / "shed"
    folder.mkdir(parents=True)
    source.mkdir()
    for k in range(3):
        Image.new("RGB", (8, 6), (k, 0, 0)).save(source / f"{k}.png")
    (source / "transforms.json").write_text("{}")
    first = street_runs.run_reconstruct(source, folder, "draft")
    photos = folder / "photographs" / "shed"
    assert sorted(path.name for path in photos.iterdir()) == ["0.png", "1.png", "2.png"]
    assert street_runs.run_reconstruct(source, folder, "draft") == first
    assert len(started) == 1
    (folder / "process.json").unlink()  # as if it had been cut off
    street_runs.run_reconstruct(source, folder, "draft")
    street_runs.run_reconstruct(source, folder, "draft", ["--learn=exposure"])  # another command is another run
    assert len(started) == 3
    assert started[0][1:3] == ["-m", "gs2d"]
