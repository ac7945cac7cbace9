"""`gs2d blocks --cluster` under twenty kills of workers, nodes and the command: the same merged bytes."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import random
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from flown import digest, tiny_blocks, write_tiny_flight
from gs2d.contrib.lab.blocks import blocks
from ray_commands import begin, blocks_words, cluster_of, lose, workers

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed (the extra `cluster`)"),
    pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc"),
]
KILLS, SCHEDULE = 20, 0.004
TASKS = ("coarse", "partition", "block-", "merge", "seams", "finish")


def test_twenty_kills_of_workers_nodes_and_the_command_change_no_byte(tmp_path: Path) -> None:
    capture = write_tiny_flight(tmp_path / "capture")
    blocks(tiny_blocks(capture, tmp_path / "straight", schedule_scale=SCHEDULE))
    job, draws, kills, log = tmp_path / "job", random.Random(0), Counter[str](), tmp_path / "said.txt"
    with cluster_of(3) as (cluster, address):
        while True:
            with log.open("w") as said, begin(blocks_words(capture, job, address, SCHEDULE), stderr=said) as process:
                while kills.total() < KILLS and process.poll() is None:
                    kind = draws.choices(("worker", "node", "command"), (0.5, 0.3, 0.2))[0]
                    while process.poll() is None and not workers(cluster.pid, TASKS):
                        time.sleep(0.1)
                    time.sleep(draws.uniform(0.0, 6.0))
                    busy = workers(cluster.pid, TASKS)
                    if not busy or process.poll() is not None:
                        continue
                    if kind == "node":
                        lose(cluster, draws.randrange(3))
                    else:
                        with contextlib.suppress(ProcessLookupError):
                            os.kill(draws.choice(busy) if kind == "worker" else process.pid, signal.SIGKILL)
                    kills[kind] += 1
                process.wait()
            if process.returncode == 0:
                break
            text = log.read_text()
            assert process.returncode in (-signal.SIGKILL, 2), text  # what was killed too often is one line
            assert process.returncode != 2 or "what is done is kept" in text, text
    print(f"{kills.total()} kills: {dict(kills)}")
    assert digest(job / "splats.ply") == digest(tmp_path / "straight/splats.ply")
    assert digest(job / "mesh.ply") == digest(tmp_path / "straight/mesh.ply")
    assert min(kills[kind] for kind in ("worker", "node", "command")) >= 1
    assert kills.total() >= 10  # the job may end before the last
