"""A task that trains and scores one run. Imports torch only in functions."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from gs2d.contrib.lab.tasks import Task
from gs2d.io.run_dir import MESH, SPLATS, RunFolder
from gs2d.pipeline.prepare.options import EvaluateOptions, TrainOptions
from gs2d.training.events import Event, NotMade, OnEvent


@dataclass(frozen=True, kw_only=True)
class TrainingTask(Task):
    """Train and score one run.

    Tasks whose recipes begin with the same stages share them through the stage cache. A task waits while another one
    trains its next stage.
    """

    train: TrainOptions  # with ``resume`` and the shared stage cache
    evaluate: EvaluateOptions | None = None  # scores beyond those of training
    stage_keys: tuple[str, ...] = ()  # one per stage; tasks with equal keys train the same stage
    # names of the scores and their inputs; a finished task is scored again if one is not in its record
    scores: tuple[str, ...] = ()

    def is_trained(self) -> bool:
        """Return whether its run has splats."""
        return RunFolder(self.train.out).file(SPLATS).exists()

    def is_done(self) -> bool:
        """Return whether the run is trained, has all scores, and still exists."""
        status = self.status()
        is_scored = set(self.scores) <= set(status.get("wanted", self.scores))
        return status["state"] == "done" and is_scored and (self.is_trained() or not status.get("trained", False))

    def details(self) -> dict[str, Any]:
        """Return whether the run is trained, which includes its image scores."""
        return {"trained": self.is_trained()}

    def keys(self) -> set[str]:
        """Return the keys of all its stages."""
        return set(self.stage_keys)

    def keys_ahead(self) -> set[str]:
        """Return the keys of the stages that its run has not finished."""
        return set(self.stage_keys[len(RunFolder(self.train.out).metrics()["stages"]) :])

    def with_threads(self, threads: int) -> TrainingTask:
        """Return the task with another number of CPU threads."""
        return replace(self, train=replace(self.train, threads=threads))

    def work(self, on_event: OnEvent) -> dict[str, Any]:
        """Train and score."""
        return {"notes": train_and_evaluate(self, on_event), "wanted": list(self.scores)}


def stage_keys(settings: Sequence[Any], stages: Sequence[Any]) -> tuple[str, ...]:
    """Return a key of each stage: a hash of the settings of the run and of all stages up to it, as JSON values.

    Keys only decide which task waits. A wrong key costs time, but never changes a result.
    """
    texts = (repr((list(settings), list(stages[: i + 1]))) for i in range(len(stages)))
    return tuple(hashlib.sha256(text.encode()).hexdigest()[:32] for text in texts)


def train_and_evaluate(task: TrainingTask, on_event: OnEvent) -> dict[str, str]:
    """Train and score one run; return why the surface has no scores, as ``{"surface": reason}``, else {}."""
    from gs2d.pipeline.finish.evaluate import evaluate_run
    from gs2d.pipeline.train.train_run import train

    missing: list[NotMade] = []

    def listen(event: Event) -> None:
        missing.extend([event] if isinstance(event, NotMade) else [])
        on_event(event)

    train(task.train, listen)
    no_mesh = [event.reason for event in missing if event.what == MESH]
    evaluate = task.evaluate
    if evaluate is not None and no_mesh:  # no surface to score
        weights = evaluate.lpips_weights
        evaluate = None if weights is None else EvaluateOptions(lpips_weights=weights)
    if evaluate is not None:
        evaluate_run(task.train.out, evaluate, on_event, threads=task.train.threads)
    return {"surface": f"no mesh: {no_mesh[0]}"} if no_mesh else {}
