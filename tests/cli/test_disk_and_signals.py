"""Full disks, Ctrl-C, lack of memory and faults of ours: one line and the right exit code."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cli_runs import TINY, one_line, spawn
from gs2d.cli import app as app_module
from gs2d.cli import run

RESUME = "interrupted; resume with: gs2d train "


def test_a_full_disk_stops_training_with_one_line_and_leaves_nothing(capture: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shutil.which("mount")
    if mount is None or os.geteuid() != 0:
        pytest.skip("only root may mount a small disk")
    made = subprocess.run([mount, "-t", "tmpfs", "-o", "size=48k", "none", str(disk)], capture_output=True, text=True)
    if made.returncode:
        pytest.skip(f"a small disk cannot be mounted here: {made.stderr.strip()}")
    try:
        done = spawn(["train", str(capture), "--out", str(disk / "run"), "--quiet", "--threads", "1", *TINY])
        assert done.returncode == 2
        assert "No space left on device" in one_line(done.stderr)
        assert list(disk.iterdir()) == []
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_an_internal_error_is_exit_code_1_with_a_traceback_only_with_verbose(
    trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gs2d.pipeline.finish import evaluate

    def broken(*_args: object, **_options: object) -> Path:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(evaluate, "evaluate_run", broken)
    assert run(["evaluate", str(trained)]) == 1
    err = capsys.readouterr().err
    assert err.splitlines() == [
        "fault in gs2d: ZeroDivisionError: a bug; run again with --verbose and report it with the traceback"
    ]
    assert run(["evaluate", str(trained), "--verbose"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_ctrl_c_exits_with_130_and_names_the_command_that_resumes(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gs2d.pipeline.train.run_logger import RunLogger

    score = RunLogger._score_stage

    def interrupted(self: RunLogger, index: int, facts: dict[str, object]) -> None:
        score(self, index, facts)
        raise KeyboardInterrupt

    monkeypatch.setattr(RunLogger, "_score_stage", interrupted)
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--quiet", "--threads", "1", *TINY]
    assert run(words) == 130
    line = capsys.readouterr().err.strip()
    assert line.startswith(f"interrupted; resume with: gs2d train {capture} --out {tmp_path / 'run'}")
    assert line.endswith("--resume")


@pytest.mark.parametrize("module", ["gs2d.cli.app", "argparse", "torch"])
def test_ctrl_c_while_modules_load_is_one_line_and_exit_code_130(module: str, trained: Path) -> None:
    code = f"""
import os, signal, sys
class Press:
    def find_spec(self, name, *_):
        if name == {module!r}:
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:
                pass  # as torch does in places
sys.meta_path.insert(0, Press())
from gs2d.cli import main
main(["evaluate", {str(trained)!r}])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_a_second_ctrl_c_does_not_interrupt_the_cleanup(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gs2d.io.run_dir import RunFolder
    from gs2d.training.trainer import Trainer

    discard = RunFolder.discard

    def impatient(self: RunFolder) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        discard(self)

    monkeypatch.setattr(Trainer, "step", lambda _self: os.kill(os.getpid(), signal.SIGINT))
    monkeypatch.setattr(RunFolder, "discard", impatient)
    assert run(["train", str(capture), "--out", str(tmp_path / "run"), "--quiet", *TINY]) == 130
    assert capsys.readouterr().err.startswith(RESUME)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "stdout", "code", "message"),
    [
        (["recipes"], "closed pipe", 141, ""),
        (["recipes"], "full disk", 2, "No space left"),
        (["train", "--help"], "closed pipe", 141, ""),
    ],
)
def test_a_stdout_that_cannot_be_written_is_not_an_internal_error(
    words: list[str], stdout: str, code: int, message: str
) -> None:
    if stdout == "full disk":
        if not os.path.exists("/dev/full"):
            pytest.skip("there is no /dev/full here")
        file = os.open("/dev/full", os.O_WRONLY)
    else:
        reader, file = os.pipe()
        os.close(reader)
    try:
        done = subprocess.run([sys.executable, "-m", "gs2d", *words], stdout=file, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(file)
    assert done.returncode == code
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == bool(message)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory"),
        RuntimeError("CUDA out of memory. Tried to allocate 20.00 MiB"),
        RuntimeError("std::bad_alloc"),
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
    ],
)
def test_out_of_memory_names_the_remedy(
    error: Exception, trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gs2d.pipeline.finish import evaluate

    def hungry(*_args: object, **_options: object) -> Path:
        raise error

    monkeypatch.setattr(evaluate, "evaluate_run", hungry)
    assert run(["evaluate", str(trained)]) == 2
    assert "--downscale" in one_line(capsys.readouterr().err)


@pytest.mark.parametrize("quiet", [True, False])
def test_a_missing_result_is_exit_code_3_with_the_command_that_makes_it(
    quiet: bool, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_args: object) -> str:
        raise ValueError("broken data stream")

    copy = Path(shutil.copytree(trained, tmp_path / "run"))
    monkeypatch.setattr("gs2d.report.sections.training_section.curves", broken)
    assert run(["evaluate", str(copy), "--json", *["--quiet"] * quiet]) == app_module.INCOMPLETE == 3
    out, err = capsys.readouterr()
    reason = "fault in gs2d: ValueError: broken data stream"
    assert json.loads(out)["missing"] == [{"what": "section training in report.html", "reason": reason}]
    last = err.splitlines()[-1]
    assert last == f"not made: section training in report.html{f' ({reason})' * quiet}; again: gs2d evaluate {copy}"
    assert err.count(reason) == 1
