"""Train the tiny ball, and compare two runs."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.prepare.options import TrainOptions

SMALL = ("init_points=150", "surface.densify.max_splats=250")
SCALE = 0.001  # 30 + 10 + 20 iterations


def options(capture: Path, out: Path, **changes: Any) -> TrainOptions:
    """Return options for a run through all three stages of 2DGS-R."""
    plain = TrainOptions(
        scene=capture, out=out, recipe="2dgs-r", schedule_scale=SCALE, overrides=SMALL, threads=1, checkpoint_every=4
    )
    return replace(plain, **changes)


def comparable(run: RunFolder) -> tuple[bytes, list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the reproducible part of a run: splats, log events without notices, metrics without times."""
    stages = [
        {k: v for k, v in stage.items() if k not in ("seconds", "peak_memory_bytes", "reused_from")}
        for stage in run.metrics()["stages"]
    ]
    log = [event for event in run.events.read() if event["kind"] != "notice"]  # they report memory and GPU
    return run.file("splats.ply").read_bytes(), log, stages


class Stop(Exception):
    """Simulates a kill."""


def spawn(capture: Path, out: Path, *more: str) -> subprocess.Popen[bytes]:
    words = [sys.executable, "-m", "gs2d", "train", str(capture), "--out", str(out), "--schedule-scale", str(SCALE)]
    words += ["--recipe", "2dgs-r", "--threads", "1", "--checkpoint-every", "4", "--quiet", *more]
    for override in SMALL:
        words += ["--set", override]
    return subprocess.Popen(words, env=dict(os.environ), stderr=subprocess.PIPE)


def failing(error: Exception) -> Callable[..., Any]:
    """Return a function that raises an error."""

    def fail(*_args: Any, **_kwargs: Any) -> None:
        raise error

    return fail
