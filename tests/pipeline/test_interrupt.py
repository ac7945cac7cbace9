"""Ctrl-C and SIGTERM while training: a checkpoint is saved, and resuming from it gives the same bytes."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ball_runs import comparable, options
from gs2d.errors import DiskError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.train.run_logger import SAME, HeldSignals
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice
from gs2d.training.trainer import Trainer


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Handlers as the command line has them; they are the same again after each test."""

    def stop(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        assert signal.getsignal(number) is stop
        signal.signal(number, handler)


def interrupted_at(monkeypatch: pytest.MonkeyPatch, iterations: set[int], number: int = signal.SIGINT) -> None:
    """Send a signal in the middle of these iterations, counted over all stages."""
    step, count = Trainer.step, iter(range(1, 10_000))

    def pressed(self: Trainer) -> None:
        if next(count) in iterations:
            os.kill(os.getpid(), number)
        step(self)

    monkeypatch.setattr(Trainer, "step", pressed)


@pytest.mark.parametrize(
    ("iteration", "number"), [(2, signal.SIGINT), (13, signal.SIGTERM), (30, signal.SIGINT), (38, signal.SIGINT)]
)
def test_a_run_interrupted_before_its_first_checkpoint_resumes_to_the_same_bytes(
    iteration: int,
    number: int,
    capture: Path,
    undisturbed: RunFolder,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    never: dict[str, Any] = {"checkpoint_every": 10_000}
    progress = {"checkpoint_every": 4}  # of `undisturbed`: it decides how often there is a line in the log
    with monkeypatch.context() as patch:
        interrupted_at(patch, {iteration}, number)
        with pytest.raises(KeyboardInterrupt):
            train(options(capture, tmp_path / "run", **never))
    run = RunFolder(tmp_path / "run")
    assert run.checkpoints()
    saved = run.checkpoints()[-1]
    before = sum((30, 10, 20)[: saved.stage_index])
    assert iteration <= before + (saved.iteration or (30, 10, 20)[saved.stage_index]) <= iteration + 10
    splats, _, stages = comparable(train(options(capture, run.path, resume=True, **progress)))
    assert splats == comparable(undisturbed)[0]
    assert stages == comparable(undisturbed)[2]


def test_a_failing_checkpoint_is_reported_and_does_not_stop_the_interrupt(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_args: object) -> None:
        raise DiskError("cannot write x: No space left on device")

    monkeypatch.setattr(RunFolder, "save_checkpoint", full)
    interrupted_at(monkeypatch, {3})
    heard: list[Event] = []
    with pytest.raises(KeyboardInterrupt):
        train(options(capture, tmp_path / "run", checkpoint_every=10_000), heard.append)
    assert any("no checkpoint at iteration" in event.text for event in heard if isinstance(event, Notice))
    assert not (tmp_path / "run").exists()


def test_a_second_signal_acts_at_once_unless_it_repeats_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    held, clock = HeldSignals(), [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    held.hold()
    os.kill(os.getpid(), signal.SIGINT)
    clock[0] = SAME / 2
    os.kill(os.getpid(), signal.SIGINT)
    assert held.pending
    clock[0] = SAME * 2
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        held.release()
    assert not held.pending


def test_an_ignored_signal_stays_ignored() -> None:
    stop = signal.signal(signal.SIGINT, signal.SIG_IGN)
    held = HeldSignals()
    held.hold()
    os.kill(os.getpid(), signal.SIGINT)
    assert not held.pending
    held.release()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    signal.signal(signal.SIGINT, stop)
