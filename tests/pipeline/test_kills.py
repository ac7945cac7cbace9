"""Kills, full disks, signals and concurrent commands at any call that changes a file lose nothing.

``kill_runs`` says how; the counts that were reached are in docs/notebook/reliability.md.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

HELPERS = Path(__file__).resolve().parents[1] / "helpers"
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the layer is for the libc of Linux")


@pytest.fixture(scope="module")
def layer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The layer that fails, compiled."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler here")
    library = tmp_path_factory.mktemp("layer") / "failing_files.so"
    words = [compiler, "-Wall", "-shared", "-fPIC", "-o", str(library), str(HELPERS / "failing_files.c"), "-ldl"]
    subprocess.run(words, check=True)
    return library


def tried(layer: Path, work: Path, commands: str, actions: str, *more: str) -> list[dict[str, Any]]:
    """Return the results of ``kill_runs`` for each command and action, after checking that none did harm."""
    environment = {
        **os.environ,
        "LD_PRELOAD": str(layer),
        "GS2D_FAILING_FILES": str(layer),
        "OMP_NUM_THREADS": "1",
        "MPLBACKEND": "Agg",
        "PYTHONPATH": os.pathsep.join([str(HELPERS), os.environ.get("PYTHONPATH", "")]),
    }
    words = [sys.executable, str(HELPERS / "kill_runs.py"), "--commands", commands, "--actions", actions]
    done = subprocess.run(
        [*words, "--work", str(work), *more], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    results = [json.loads(line) for line in done.stdout.splitlines()]
    assert [result["wrong"] for result in results] == [[]] * len(results), done.stderr[-2000:]
    assert len(results) == len(commands.split(",")) * len(actions.split(","))
    return results


def test_a_killed_page_leaves_the_old_or_the_new_file(layer: Path, tmp_path: Path) -> None:
    """The next test does the same to an export."""
    for result in tried(layer, tmp_path, "page", "kill,tear,full"):
        assert result["kinds"].keys() >= {"open", "write", "fsync", "rename"}
        assert result["tried"] == result["calls"] >= 5


def test_the_recorded_states_are_those_after_a_kill_a_torn_write_and_a_full_disk(layer: Path, tmp_path: Path) -> None:
    """``--states``, for long commands, looks at a process that stands still, instead of ending one at each call."""
    for result in tried(layer, tmp_path, "export", "kill,tear,full", "--states", "--compare"):
        assert result["tried"] == result["calls"] >= 5
        assert 3 <= result["states"] < result["calls"]


def test_the_harness_detects_a_file_that_is_written_in_place(layer: Path, tmp_path: Path) -> None:
    """An export that writes in place: killed half-way it leaves half a file, which must be detected."""
    code = (
        "import kill_commands, kill_runs, sys\n"
        "def write(run, out):\n"
        "    with open(out.with_suffix('.json'), 'wb', buffering=0) as file:\n"
        "        file.write(b'[' + b'1, ' * 50 + b'1]')\n"
        "kill_commands.export_run = write\n"
        "sys.argv = ['x', '--commands', 'export', '--actions', 'tear', '--work', sys.argv[1]]\n"
        "kill_runs.main()\n"
    )
    paths = os.pathsep.join([str(HELPERS), os.environ.get("PYTHONPATH", "")])
    environment = {"LD_PRELOAD": str(layer), "GS2D_FAILING_FILES": str(layer), "PYTHONPATH": paths}
    words = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(words, env={**os.environ, **environment}, capture_output=True, text=True, check=True)
    (result,) = map(json.loads, done.stdout.splitlines())
    assert any("out.json is not whole" in text for text in result["wrong"])


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_a_training_killed_at_any_call_resumes_to_the_same_bytes(layer: Path, tmp_path: Path) -> None:
    for result in tried(layer, tmp_path, "train", "kill,tear,full", "--states"):
        assert result["tried"] == result["calls"] > 200


@pytest.mark.slow
def test_a_mesh_or_report_killed_at_any_call_can_be_made_again(layer: Path, tmp_path: Path) -> None:
    for result in tried(layer, tmp_path, "mesh,report", "kill,tear,full"):
        assert result["tried"] == result["calls"] >= 5


@pytest.mark.slow
@pytest.mark.timeout(6000)
@pytest.mark.parametrize(("command", "how"), [
    ("sweep", ["kill,tear,full", "--states"]), ("reconstruct", ["kill,tear", "--states"]), ("reconstruct", ["full"])
])  # fmt: skip
def test_a_reconstruction_or_sweep_killed_at_any_call_can_continue(
    layer: Path, tmp_path: Path, command: str, how: list[str]
) -> None:
    if command == "reconstruct":
        pytest.importorskip("pycolmap", reason="no pycolmap: pip install pycolmap")
    for result in tried(layer, tmp_path, command, *how):
        assert result["tried"] == result["calls"] > 200


@pytest.mark.slow
def test_random_kills_stops_and_clock_changes_do_not_change_the_result(layer: Path, tmp_path: Path) -> None:
    tried(layer, tmp_path, "train", "random,stop,clock", "--times", "10")


@pytest.mark.slow
def test_two_commands_in_one_folder_give_the_result_of_one(layer: Path, tmp_path: Path) -> None:
    tried(layer, tmp_path, "train,mesh,page", "twice", "--times", "10")


@pytest.mark.slow
def test_a_photograph_that_changes_before_a_resume_is_an_error(layer: Path, tmp_path: Path) -> None:
    tried(layer, tmp_path, "train", "photograph")
