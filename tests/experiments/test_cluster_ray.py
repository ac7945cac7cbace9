"""`--cluster` on a real Ray cluster: three nodes of this machine, two of them lost in the middle."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from flown import WORDS, digest, tiny_blocks, write_tiny_flight
from gs2d.experiments.blocks import blocks
from room_photos import Room

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed (the extra `cluster`)"),
]
NODES = Path(__file__).resolve().parents[1] / "helpers" / "ray_nodes.py"
SCHEDULE = 0.004  # 120 iterations a block: seconds in which a node can be lost


@pytest.fixture(scope="module")
def nodes() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A head without CPUs and two nodes with one each; the program, and the address."""
    with subprocess.Popen(
        [sys.executable, str(NODES), "2"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
        process.communicate(timeout=60)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_flight(tmp_path_factory.mktemp("flight") / "capture")


@pytest.fixture(scope="module")
def straight(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("straight") / "job"
    blocks(tiny_blocks(capture, out, schedule_scale=SCHEDULE))
    return out


def command(capture: Path, job: Path, address: str) -> list[str]:
    """Return the words that do what ``straight`` does, on a cluster."""
    words = ["blocks", str(capture), "--out", str(job), "--blocks", "2x2", "--recipe", "2dgs", "--robust", "off"]
    words += ["--partition", "min_views=3", "--partition", "coarse.schedule=0.5", "--schedule-scale", str(SCHEDULE)]
    words += [word for change in (*WORDS, "surface.densify.max_splats=600") for word in ("--set", change)]
    words += ["--backend", "cpu", "--threads", "1", "--no-page", "--checkpoint-every", "4"]
    return [*words, "--cluster", address]


def begin(words: list[str], code: str = "") -> subprocess.Popen[str]:
    program = f"import sys, gs2d; {code}\nfrom gs2d.cli import main; main()"
    environment = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
    return subprocess.Popen(
        [sys.executable, "-c", program, *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def read_until(process: subprocess.Popen[str], words: str) -> str:
    assert process.stderr is not None
    found = ""
    for line in process.stderr:
        found += line
        if words in line:
            return found
    pytest.fail(f"{words!r} was never said: {found}")


def test_nodes_are_lost_in_the_middle_and_no_byte_changes(
    nodes: tuple[subprocess.Popen[str], str], capture: Path, straight: Path, tmp_path: Path
) -> None:
    cluster, address = nodes
    assert cluster.stdin is not None
    assert cluster.stdout is not None
    with begin(command(capture, tmp_path / "job", address)) as process:
        said = read_until(process, "block-0-1 begins on")
        cluster.stdin.write("lose\n")
        cluster.stdin.flush()
        said += process.communicate()[1]
    assert cluster.stdout.readline() == "lost\n"
    assert process.returncode == 0, said
    assert "was lost; it goes on on" in said
    for line in said.splitlines():  # nothing of Ray's own
        assert line.startswith(("jobs (9)", "jobs: ", "note ")), said
    for name in ("splats.ply", "mesh.ply"):
        assert digest(tmp_path / "job" / name) == digest(straight / name)


def test_an_interrupted_command_goes_on_to_the_same_bytes(
    nodes: tuple[subprocess.Popen[str], str], capture: Path, straight: Path, tmp_path: Path
) -> None:
    words = command(capture, tmp_path / "job", nodes[1])
    with begin(words) as process:
        read_until(process, "block-0-0: starting from")
        process.send_signal(signal.SIGINT)
        said = process.communicate()[1]
    assert process.returncode == 130, said
    assert said.splitlines()[-1].startswith("interrupted")
    assert "Traceback" not in said
    assert not (tmp_path / "job" / "splats.ply").exists()
    with begin(words) as process:
        said = process.communicate()[1]
    assert process.returncode == 0, said
    assert "coarse begins" not in said  # that was done
    assert digest(tmp_path / "job" / "splats.ply") == digest(straight / "splats.ply")


def test_another_version_on_the_nodes_is_one_line(
    nodes: tuple[subprocess.Popen[str], str], capture: Path, tmp_path: Path
) -> None:
    with begin(command(capture, tmp_path / "job", nodes[1]), "gs2d.__version__ = '9.9'") as process:
        said = process.communicate()[1]
    assert process.returncode == 2, said
    assert "this command 9.9; install the same version on all machines" in said.splitlines()[-1]
    assert "Traceback" not in said


def test_an_address_without_a_cluster_is_one_line(capture: Path, tmp_path: Path) -> None:
    with begin([*command(capture, tmp_path / "job", "127.0.0.1:1"), "--quiet"]) as process:
        said = process.communicate()[1]
    assert process.returncode == 2, said
    assert len(said.splitlines()) == 1
    assert said.startswith("error: no Ray cluster at 127.0.0.1:1 (Connection refused); start one with")


def test_photographs_become_a_run_though_the_machine_of_the_training_is_lost(
    nodes: tuple[subprocess.Popen[str], str], room: Room, tmp_path: Path
) -> None:
    cluster, address = nodes
    assert cluster.stdin is not None
    assert cluster.stdout is not None
    words = ["reconstruct", str(room.photos), "--threads", "1", "--downscale", "4", "--recipe", "2dgs", "--robust"]
    words += ["off", "--schedule-scale", "0.02", "--checkpoint-every", "20", "--no-page"]
    words += ["--set", "init_points=100", "--set", "surface.densify.max_splats=150"]
    with begin([*words, "--out", str(tmp_path / "run"), "--cluster", address]) as process:
        said = read_until(process, "training begins on")
        said += read_until(process, "training: starting from")
        cluster.stdin.write("lose\n")
        cluster.stdin.flush()
        said += process.communicate()[1]
    assert cluster.stdout.readline() == "lost\n"
    assert process.returncode == 0, said
    assert "cameras: 12 of 12 photographs have a place" in said
    assert "training: its process or its machine" in said
    shutil.copytree(tmp_path / "run/capture", tmp_path / "here/capture")
    with begin([*words, "--out", str(tmp_path / "here"), "--resume"]) as process:
        said = process.communicate()[1]
    assert process.returncode == 0, said
    assert digest(tmp_path / "here/splats.ply") == digest(tmp_path / "run/splats.ply")
