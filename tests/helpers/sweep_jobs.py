"""Sweeps of jobs that train nothing, and claims of processes that are gone."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

from gs2d.experiments.execute import Sweep, SweepJob
from gs2d.pipeline.options import TrainOptions


def make_sweep(folder: Path, keys: dict[str, tuple[str, ...]]) -> Sweep:
    """Jobs by name with the keys of their stages."""
    jobs = tuple(
        SweepJob(name=name, train=TrainOptions(scene=folder, out=folder / "runs" / name), stage_keys=stages)
        for name, stages in keys.items()
    )
    return Sweep(folder=folder, jobs=jobs, cache=folder / "cache")


def dead_pid() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def write_claim(path: Path, **facts: Any) -> None:
    path.write_text(json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "began": None, **facts}))
