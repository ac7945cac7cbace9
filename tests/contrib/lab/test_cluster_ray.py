"""`--cluster` on a real Ray cluster: three nodes of this machine, two of them lost in the middle."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from flown import digest, tiny_blocks
from gs2d.contrib.lab.blocks import blocks
from ray_commands import begin, blocks_words, cluster_of, lose, read_until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed (the extra `cluster`)"),
]
SCHEDULE = 0.004  # 120 iterations a block: seconds in which a node can be lost


@pytest.fixture(scope="module")
def nodes() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A head without CPUs and two nodes with one each; the program, and the address."""
    with cluster_of(2) as started:
        yield started


@pytest.fixture(scope="module")
def straight(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("straight") / "job"
    blocks(tiny_blocks(capture, out, schedule_scale=SCHEDULE))
    return out


def test_nodes_are_lost_in_the_middle_and_no_byte_changes(
    nodes: tuple[subprocess.Popen[str], str], capture: Path, straight: Path, tmp_path: Path
) -> None:
    cluster, address = nodes
    with begin(blocks_words(capture, tmp_path / "job", address, SCHEDULE)) as process:
        said = read_until(process, "block-0-1 starts on")
        lose(cluster)
        said += process.communicate()[1]
    assert process.returncode == 0, said
    assert "was lost; it continues on" in said
    for line in said.splitlines():  # nothing of Ray's own
        assert line.startswith(("tasks (9)", "tasks: ", "note ")), said
    for name in ("splats.ply", "mesh.ply"):
        assert digest(tmp_path / "job" / name) == digest(straight / name)


def test_an_interrupted_command_goes_on_to_the_same_bytes(
    nodes: tuple[subprocess.Popen[str], str], capture: Path, straight: Path, tmp_path: Path
) -> None:
    words = [*blocks_words(capture, tmp_path / "job", nodes[1], SCHEDULE), "--verbose"]
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
