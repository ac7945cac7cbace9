"""``gs2d train --sharded``: the run of one process, checkpoints, kills, other numbers of processes, what is refused."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

import gs2d.cli
from gs2d.core.splats import Splats
from gs2d.io.run_dir import RunFolder, load_tensors
from gs2d.io.splat_ply import read_splats
from process_runs import ITERATIONS, in_processes, torchrun, words
from tiny import write_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("captures") / "ball", train=4, test=1, size=16)


@pytest.fixture(scope="module")
def whole(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sharded run of two processes that nothing disturbs."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert in_processes(2, words(capture, out, "--sharded")) == [(0, ""), (0, "")]
    return out


def bytes_of(run: Path) -> bytes:
    return (run / "splats.ply").read_bytes()


def near(first: Splats, second: Splats, most: float) -> bool:
    """Whether all numbers of the two are the same to ``most``."""
    other = dict(second.items())
    return all(
        tensor.shape == other[name].shape and float((tensor - other[name]).abs().max()) < most
        for name, tensor in first.items()
        if tensor.numel()
    )


def test_a_sharded_run_is_that_of_views_in_parallel(capture: Path, whole: Path, tmp_path: Path) -> None:
    """Log, scores and checkpoints are there; splats are those of processes that have all, to rounding."""
    run = RunFolder(whole)
    kinds = [entry["kind"] for entry in run.events.read()]
    assert kinds.count("initialised") == kinds.count("processes") == kinds.count("stage_end") == 1
    assert "densify" in kinds
    assert "step" in kinds
    end = load_tensors(run.checkpoints()[-1].path)["state"]
    assert end["processes"] == [[0, 0, 2, 1]]
    assert run.metrics()["stages"][0]["iterations"] == ITERATIONS
    assert run.metrics()["stages"][0]["splats"] == len(end["splats"]["means"])
    assert in_processes(2, words(capture, tmp_path / "run")) == [(0, ""), (0, "")]
    assert near(read_splats(whole / "splats.ply"), read_splats(tmp_path / "run" / "splats.ply"), 1e-3)
    assert [path.name for path in whole.iterdir() if path.name.startswith(".")] == [".lock"]


@pytest.mark.slow
@pytest.mark.parametrize("rank", [0, 1])
def test_a_killed_rank_ends_the_run_which_goes_on_to_the_same_bytes(
    rank: int, capture: Path, whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    found = in_processes(2, words(capture, out, "--sharded"), f"signal={rank}:5:{int(signal.SIGKILL)}")
    assert found[rank] == (-signal.SIGKILL, "")
    if rank == 1:
        code, line = found[0]
        assert code == 2
        assert line.startswith("error: process 0 of 2 lost contact with another one")
    assert [checkpoint.iteration for checkpoint in RunFolder(out).checkpoints()] == [4, 8]
    assert in_processes(2, words(capture, out, "--sharded", "--resume")) == [(0, ""), (0, "")]
    assert bytes_of(out) == bytes_of(whole)


@pytest.mark.slow
def test_a_run_goes_on_with_another_number_of_processes_and_without_shards(capture: Path, tmp_path: Path) -> None:
    """Four, of which one is killed after the first checkpoint; then three, two without shards, one."""
    out = tmp_path / "run"
    stop, kill = int(signal.SIGTERM), int(signal.SIGKILL)
    in_processes(4, words(capture, out, "--sharded"), f"signal=2:2:{kill}")
    in_processes(3, words(capture, out, "--sharded", "--resume"), f"signal=2:1:{stop}")
    in_processes(2, words(capture, out, "--resume"), f"signal=0:1:{stop}")
    assert in_processes(1, words(capture, out, "--resume")) == [(0, "")]
    state = load_tensors(RunFolder(out).checkpoints()[-1].path)["state"]
    assert [since[2:] for since in state["processes"]] == [[4, 1], [3, 1], [2], [1]]
    assert RunFolder(out).metrics()["stages"][0]["iterations"] == ITERATIONS


@pytest.mark.slow
def test_a_signal_to_any_process_keeps_a_checkpoint(capture: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    (code, line), (_, silent) = in_processes(2, words(capture, out, "--sharded"), f"signal=1:4:{int(signal.SIGTERM)}")
    assert code == 130
    assert line.startswith("interrupted; resume with: gs2d train")
    assert silent == ""
    assert in_processes(2, words(capture, out, "--sharded", "--resume")) == [(0, ""), (0, "")]
    assert bytes_of(out) == bytes_of(whole)


@pytest.mark.slow
def test_torchrun_starts_a_whole_run_of_2dgs_r(capture: Path, tmp_path: Path) -> None:
    """The real launcher; ranking, clone, mesh, report and page."""
    out = tmp_path / "run"
    small = ("--schedule-scale", "0.0005", "--threads", "1", "--quiet", "--set", "init_points=80")
    command = ("-m", "gs2d", "train", str(capture), "--out", str(out), "--recipe", "2dgs-r", "--sharded", *small)
    done = torchrun("--nproc-per-node", "3", *command)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in out.iterdir()} >= {"splats.ply", "mesh.ply", "report.html", "scene.html"}
    kinds = [entry["kind"] for entry in RunFolder(out).events.read()]
    assert {"ranked", "cloned", "after_clone"} <= set(kinds)


def test_one_process_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = write_capture(tmp_path / "ball", train=4, test=1, size=16)
    assert gs2d.cli.run(["train", str(capture), "--out", str(tmp_path / "run"), "--sharded"]) == 2
    line = capsys.readouterr().err
    assert line.startswith("error: --sharded needs several processes, got one; torchrun --standalone")
    assert line.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_the_viewer_is_refused(capture: Path, tmp_path: Path) -> None:
    found = in_processes(2, words(capture, tmp_path / "run", "--sharded", "--viewer"))
    assert [code for code, _ in found] == [2, 2]
    (line,) = "".join(text for _, text in found).splitlines()
    assert line.startswith("error: --viewer shows all splats, which no process has with --sharded")
    assert not (tmp_path / "run").exists()
