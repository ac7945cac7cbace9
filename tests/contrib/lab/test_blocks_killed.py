"""`gs2d blocks` under twenty kills of the command, of what trains a block, and of both: the same merged bytes."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from flown import WORDS, digest, tiny_blocks, write_tiny_flight
from gs2d.contrib.lab.blocks import blocks

KILLS = 20


def command(capture: Path, job: Path) -> list[str]:
    """Return the command that does what ``tiny_blocks`` does, two blocks at a time."""
    words = ["blocks", str(capture), "--out", str(job), "--blocks", "2x2", "--recipe", "2dgs", "--robust", "off"]
    words += ["--set", "partition.min_views=3", "--set", "partition.coarse.schedule=0.5", "--schedule-scale", "0.0006"]
    words += [word for change in (*WORDS, "surface.densify.max_splats=600") for word in ("--set", change)]
    words += [
        "--backend",
        "cpu",
        "--threads",
        "1",
        "--set",
        "page=false",
        "--checkpoint-every",
        "4",
        "--set",
        "slots=2",
        "--quiet",
    ]
    return [sys.executable, "-m", "gs2d", *words]


def children(process: int) -> list[int]:
    """Return the processes of a command that train a block."""
    try:
        found = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return []
    return [int(child) for child in found if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def kill(process: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="children are looked up in /proc")
def test_twenty_kills_of_blocks_and_of_the_command_change_no_byte(tmp_path: Path) -> None:
    capture = write_tiny_flight(tmp_path / "capture")
    blocks(tiny_blocks(capture, tmp_path / "straight"))
    job, draws, kills, workers = tmp_path / "job", random.Random(0), 0, 0
    deadline = time.monotonic() + 900
    while True:
        assert time.monotonic() < deadline
        with subprocess.Popen(command(capture, job), stderr=subprocess.PIPE, text=True) as process:
            while kills < KILLS and process.poll() is None:
                of_worker = draws.random() < 0.6
                while of_worker and process.poll() is None and not children(process.pid):
                    time.sleep(0.05)
                time.sleep(draws.uniform(1.0, 8.0))
                below = children(process.pid) if of_worker else []
                if below:
                    kill(draws.choice(below))
                    workers += 1
                else:
                    kill(process.pid)
                kills += 1
            said = process.communicate()[1]
        if process.returncode == 0:
            break
        assert process.returncode in (-signal.SIGKILL, 2), said  # a block that was killed too often is one line
        assert process.returncode != 2 or "what is done is kept" in said, said
    assert digest(job / "splats.ply") == digest(tmp_path / "straight/splats.ply")
    assert digest(job / "mesh.ply") == digest(tmp_path / "straight/mesh.ply")
    assert kills >= 5
    assert workers >= 1
