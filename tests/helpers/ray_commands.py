"""Run gs2d commands on the cluster of ``ray_nodes.py``, and kill its processes."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from flown import WORDS

NODES = Path(__file__).with_name("ray_nodes.py")


@contextlib.contextmanager
def cluster_of(count: int) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a head without CPUs and ``count`` nodes with one CPU each; yield the process and the address."""
    with subprocess.Popen(
        [sys.executable, str(NODES), str(count)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
        process.communicate(timeout=600)


def lose(cluster: subprocess.Popen[str], *which: int) -> None:
    """Kill the processes of nodes (all by default), and wait until new nodes have joined."""
    assert cluster.stdin is not None
    assert cluster.stdout is not None
    cluster.stdin.write(" ".join(["lose", *map(str, which)]) + "\n")
    cluster.stdin.flush()
    assert cluster.stdout.readline() == "lost\n"


def blocks_words(capture: Path, job: Path, address: str, schedule: float) -> list[str]:
    """Return command-line words equivalent to ``tiny_blocks``, on a cluster."""
    words = ["blocks", str(capture), "--out", str(job), "--blocks", "2x2", "--recipe", "2dgs", "--robust", "off"]
    words += [
        "--set",
        "partition.min_views=3",
        "--set",
        "partition.coarse.schedule=0.5",
        "--schedule-scale",
        str(schedule),
    ]
    words += [word for change in (*WORDS, "surface.densify.max_splats=600") for word in ("--set", change)]
    words += ["--backend", "cpu", "--threads", "1", "--set", "page=false", "--checkpoint-every", "4"]
    return [*words, "--cluster", address]


def begin(words: list[str], code: str = "", stderr: int | IO[str] = subprocess.PIPE) -> subprocess.Popen[str]:
    """Start a gs2d command after running ``code``."""
    program = f"import sys, gs2d; {code}\nfrom gs2d.cli import main; main()"
    environment = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
    return subprocess.Popen(
        [sys.executable, "-c", program, *words],
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        text=True,
        env=environment,
    )


def read_until(process: subprocess.Popen[str], words: str) -> str:
    """Read a command's output until ``words`` appear; return everything read so far."""
    assert process.stderr is not None
    found = ""
    for line in process.stderr:
        found += line
        if words in line:
            return found
    pytest.fail(f"{words!r} was never said: {found}")


def below(process: int) -> Iterator[int]:
    """Yield the descendants of a process (Linux)."""
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{process}/task").iterdir():
            for child in (thread / "children").read_text().split():
                yield int(child)
                yield from below(int(child))


def workers(cluster: int, names: tuple[str, ...]) -> list[int]:
    """Return the cluster processes that run a task with one of these names."""
    found = []
    for process in below(cluster):
        with contextlib.suppress(OSError):
            title = Path(f"/proc/{process}/cmdline").read_bytes().decode(errors="replace")
            found += [process] if title.startswith(tuple(f"ray::{name}" for name in names)) else []
    return found
