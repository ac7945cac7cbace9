"""A training run as a task of a list: trained, then scored; and what became of it.

Never imports torch at the top.
"""

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
class Job(Task):
    """One run of a list: trained, then scored.

    Jobs whose recipes begin with the same stages share them through the stage cache: of several at once those wait
    whose next stage another one is training.

    Attributes
    ----------
    train : TrainOptions
        With ``resume``, and with the stage cache of the list.
    evaluate : EvaluateOptions or None
        What is scored beyond what training scores.
    stage_keys : tuple of str
        One for each stage; jobs with equal keys train the same stage.
    wanted : tuple of str
        What is scored, and with what: a finished job is scored again when it was scored with less.
    """

    train: TrainOptions
    evaluate: EvaluateOptions | None = None
    stage_keys: tuple[str, ...] = ()
    wanted: tuple[str, ...] = ()

    def is_trained(self) -> bool:
        """Return whether its run has splats."""
        return RunFolder(self.train.out).file(SPLATS).exists()

    def is_done(self) -> bool:
        """Return whether nothing is left to do: trained, scored with all that is wanted, and not deleted since."""
        outcome = self.outcome()
        is_scored = set(self.wanted) <= set(outcome.get("wanted", self.wanted))
        return outcome["state"] == "done" and is_scored and (self.is_trained() or not outcome.get("trained", False))

    def facts(self) -> dict[str, Any]:
        """Return what is true of it however it ended: where it was trained, its pictures were scored."""
        return {"trained": self.is_trained()}

    def keys(self) -> set[str]:
        """Return the keys of all its stages."""
        return set(self.stage_keys)

    def keys_ahead(self) -> set[str]:
        """Return the keys of the stages that its run has not finished."""
        return set(self.stage_keys[len(RunFolder(self.train.out).metrics()["stages"]) :])

    def with_threads(self, threads: int) -> Job:
        """Return the job on so many CPU threads."""
        return replace(self, train=replace(self.train, threads=threads))

    def work(self, on_event: OnEvent) -> dict[str, Any]:
        """Train and score."""
        return {"notes": train_and_evaluate(self, on_event), "wanted": list(self.wanted)}


def stage_keys(facts: Sequence[Any], stages: Sequence[Any]) -> tuple[str, ...]:
    """Return a key of each stage: a hash of what the runs have in common and of the stages so far (as JSON values).

    Cheaper than ``Job.stage_key`` of the pipeline, which reads the photographs, and only used to decide who waits for
    whom: a wrong one costs time, never a wrong result.
    """
    texts = (repr((list(facts), list(stages[: i + 1]))) for i in range(len(stages)))
    return tuple(hashlib.sha256(text.encode()).hexdigest()[:32] for text in texts)


def train_and_evaluate(job: Job, on_event: OnEvent) -> dict[str, str]:
    """Train and score one run; returns what could not be had, with reasons (``surface``).

    Raises
    ------
    Gs2dError
        The run itself failed.
    """
    from gs2d.pipeline.finish.evaluate import evaluate_run
    from gs2d.pipeline.train.train_run import train

    missing: list[NotMade] = []

    def listen(event: Event) -> None:
        missing.extend([event] if isinstance(event, NotMade) else [])
        on_event(event)

    train(job.train, listen)
    no_mesh = [event.reason for event in missing if event.what == MESH]
    evaluate = job.evaluate
    if evaluate is not None and no_mesh:  # nothing to compare with a true surface
        weights = evaluate.lpips_weights
        evaluate = None if weights is None else EvaluateOptions(lpips_weights=weights)
    if evaluate is not None:
        evaluate_run(job.train.out, evaluate, on_event, threads=job.train.threads)
    return {"surface": f"no mesh: {no_mesh[0]}"} if no_mesh else {}
