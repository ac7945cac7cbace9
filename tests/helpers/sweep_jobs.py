"""Sweep jobs without training."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from gs2d.contrib.lab.training_task import TrainingTask
from gs2d.pipeline.prepare.options import TrainOptions


def make_jobs(folder: Path, keys: dict[str, tuple[str, ...]]) -> tuple[TrainingTask, ...]:
    """Jobs by name with the keys of their stages; their capture is an empty folder, so that training fails at once."""
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
    """What a process of its own does in place of training: that of "b" is killed, the others fail."""
    if job.name == "b":
        os.kill(os.getpid(), signal.SIGKILL)
    job.write("failed", reason="no photographs")
