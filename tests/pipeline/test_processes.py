"""``gs2d train`` in several processes: files, kills, Ctrl-C, resuming and errors."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

import ball_runs
import gs2d.cli
import together_run
from gs2d.io.run_dir import RunFolder, load_tensors
from process_runs import ITERATIONS, in_processes, torchrun, words
from tiny import write_capture


def splats(run: Path) -> bytes:
    """The bytes of the result."""
    return (run / "splats.ply").read_bytes()


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("captures") / "ball", train=4, test=1, size=16)


@pytest.fixture(scope="module")
def whole(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of two processes that nothing disturbs."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert in_processes(2, words(capture, out)) == [(0, ""), (0, "")]
    return out


def test_one_of_two_processes_writes_the_run(whole: Path) -> None:
    run = RunFolder(whole)
    kinds = [entry["kind"] for entry in run.events.read()]
    assert kinds.count("initialised") == kinds.count("processes") == kinds.count("stage_finished") == 1
    assert "densified" in kinds
    end = load_tensors(run.checkpoints()[-1].path)
    assert end["state"]["processes"] == [[0, 0, 2]]
    assert run.metrics()["stages"][0]["iterations"] == ITERATIONS
    assert [path.name for path in whole.iterdir() if path.name.startswith(".")] == [".lock"]


@pytest.mark.slow
def test_a_killed_process_ends_the_run_which_can_resume(capture: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    (code, line), (killed, silent) = in_processes(2, words(capture, out), f"signal=1:5:{int(signal.SIGKILL)}")
    assert (code, killed, silent) == (2, -signal.SIGKILL, "")
    assert line.startswith("error: process 0 of 2 lost contact with another process")
    assert line.count("\n") == 1
    assert [checkpoint.iteration for checkpoint in RunFolder(out).checkpoints()] == [4, 8]
    assert in_processes(2, words(capture, out, "--resume")) == [(0, ""), (0, "")]
    assert splats(out) == splats(whole)


@pytest.mark.slow
def test_a_signal_to_any_process_saves_a_checkpoint(capture: Path, whole: Path, tmp_path: Path) -> None:
    """At the fourth iteration, of views 6 and 7 of the schedule."""
    out = tmp_path / "run"
    (code, line), (_, silent) = in_processes(2, words(capture, out), f"signal=1:4:{int(signal.SIGTERM)}")
    assert code == 130
    assert line.startswith("interrupted; resume with: gs2d train")
    assert silent == ""
    assert RunFolder(out).checkpoints()[-1].iteration == 8
    assert in_processes(2, words(capture, out, "--resume")) == [(0, ""), (0, "")]
    assert splats(out) == splats(whole)


@pytest.mark.slow
def test_the_number_of_processes_may_change_between_resumes(capture: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    in_processes(2, words(capture, out), f"signal=0:3:{int(signal.SIGINT)}")
    ((code, _),) = in_processes(1, words(capture, out, "--resume"), f"signal=0:3:{int(signal.SIGINT)}")
    assert code == 130
    assert in_processes(2, words(capture, out, "--resume")) == [(0, ""), (0, "")]
    state = load_tensors(RunFolder(out).checkpoints()[-1].path)["state"]
    assert [count for *_, count in state["processes"]] == [2, 1, 2]
    assert splats(out) != splats(whole)
    assert RunFolder(out).metrics()["stages"][0]["iterations"] == ITERATIONS


def test_different_commands_are_an_error(capture: Path, tmp_path: Path) -> None:
    found = in_processes(2, words(capture, tmp_path / "run"), "seed=1:5")
    assert [code for code, _ in found] == [2, 2]
    (line,) = "".join(text for _, text in found).splitlines()
    assert line.startswith(
        "error: process 1 of 2: all processes must train the same, got another recipe than process 0"
    )
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("rank", ["0", "1"])
def test_process_0_reports_differences(
    rank: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said = {"RANK": rank, "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "1"}
    for name, value in said.items():
        monkeypatch.setenv(name, value)
    assert gs2d.cli.run(["mesh", "runs/x"]) == 2
    line = "error: gs2d mesh runs in one process, got 2; gs2d train is for torchrun\n"
    assert capsys.readouterr().err == (line if rank == "0" else "")


@pytest.mark.slow
def test_torchrun_restarts_a_killed_process(capture: Path, whole: Path, tmp_path: Path) -> None:
    program = [
        together_run.__file__,
        f"signal=1:5:{int(signal.SIGKILL)}",
        *words(capture, tmp_path / "run", "--resume"),
    ]
    done = torchrun("--nproc-per-node", "2", "--max-restarts", "1", *program)
    assert done.returncode == 0, done.stderr
    assert splats(tmp_path / "run") == splats(whole)


@pytest.mark.slow
def test_four_processes_of_torchrun_agree(tmp_path: Path) -> None:
    """The real launcher, the whole command with mesh and report, all stages of 2DGS-R."""
    out = tmp_path / "run"
    given = [
        "train",
        str(write_capture(tmp_path / "ball")),
        "--out",
        str(out),
        "--schedule-scale",
        str(ball_runs.SCALE),
        "--json",
    ]
    for override in ball_runs.SMALL:
        given += ["--set", override]
    done = torchrun("--nproc-per-node", "4", "-m", "gs2d", *given, "--recipe", "2dgs-r", "--threads", "1", "--quiet")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("{")
    assert done.stdout.count('"stages"') == 1
    assert {path.name for path in out.iterdir()} >= {"splats.ply", "mesh.ply", "report.html", "scene.html"}
    assert load_tensors(RunFolder(out).checkpoints()[-1].path)["state"]["processes"] == [[0, 0, 4]]
