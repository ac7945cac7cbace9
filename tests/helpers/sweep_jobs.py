"""Sweep jobs without training."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from gs2d.contrib.lab.training_task import TrainingTask
from gs2d.pipeline.prepare.options import TrainOptions


def make_jobs(folder: Path, keys: dict[str, tuple[str, ...]]) -> tuple[TrainingTask, ...]:
    """Return jobs by name with the keys of their stages; the capture is an empty folder, so training fails at once."""
    return tuple(
        TrainingTask(
            name=name,
            record=folder / "jobs" / f"{name}.json",
            train=TrainOptions(scene=folder, out=folder / "runs" / name),
            stage_keys=stages,
        )
        for name, stages in keys.items()
    )


def fail_or_die(job: TrainingTask, _device: str | None) -> None:
    """Replace training in a child process: the job "b" is killed, the others fail."""
    if job.name == "b":
        os.kill(os.getpid(), signal.SIGKILL)
    job.write("failed", reason="no photographs")
