"""Progress and time left of a whole run, from the progress of training."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from gs2d.core.text import duration
from gs2d.training.events import Phase, RunPart, RunPlan

GREW = (2.0, 60.0)  # factor and seconds by which an estimate must exceed the shown time for the work to have grown
_TRAINING = "training"


class Countdown:
    """The shown time left, which increases only if the work grew."""

    def __init__(self) -> None:
        self._shown = math.inf

    def show(self, left: float) -> float:
        """Take a new estimate and return the seconds to show."""
        self._shown = min(left, self._shown) if left <= GREW[0] * self._shown + GREW[1] else left
        return self._shown


class WholeRun:
    """Follows the events of a run from its plan on."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._parts: tuple[RunPart, ...] = ()
        self.on_plan(RunPlan(()))

    def on_plan(self, plan: RunPlan) -> None:
        """Take a plan. A subset of the current plan is ignored; the same plan starts another run."""
        if set(plan.parts) < set(self._parts):
            return
        self._parts = plan.parts
        self._now = -1  # index of the part; -1: before the first
        self._began = 0.0  # clock, of the part
        self._phase: Phase | None = None  # the first one of the part
        self._training: float | None = None  # seconds of training, by its progress
        self._left: float | None = None  # seconds of training
        self._own = False  # whether the running phase belongs to the part
        self._shown = Countdown()

    def on_phase(self, phase: Phase) -> None:
        """Move to the part that begins with a phase, if one does."""
        for index in range(max(self._now, 0), len(self._parts)):
            if phase.name.startswith(self._parts[index].begins):
                if index != self._now:
                    self._now, self._began, self._phase = index, self._clock(), None
                self._phase, self._own = self._phase or phase, True
                return
        self._own = False

    def on_step(self, done: int) -> None:
        """Count a step of training."""
        if not self._own or self._phase is None or self._parts[self._now].name != _TRAINING:
            return
        elapsed = self._clock() - self._began
        self._training = self._phase.seconds_in_all(done, elapsed) or self._training
        self._left = self._phase.seconds_left(done, elapsed)

    def line(self) -> str:
        """Return "part 5 of 7: training; whole run: about 14 min left"; without a plan ""."""
        if self._now < 0 or len(self._parts) < 2:
            return ""
        text = f"part {self._now + 1} of {len(self._parts)}: {self._parts[self._now].name}"
        left = self.left()
        return text if left is None else f"{text}; whole run: about {duration(left)} left"

    def left(self) -> float | None:
        """Return the seconds until the run ends, or None if there is no estimate yet.

        The time of later parts is estimated as a fraction of the time of training.
        """
        if self._training is None:
            return None
        part, spent = self._parts[self._now], self._clock() - self._began
        left = self._left if part.name == _TRAINING else (part.of_training or 0.0) * self._training - spent
        if left is None or left < 0:  # longer than expected
            return None
        later = sum(part.of_training or 0.0 for part in self._parts[self._now + 1 :])
        return self._shown.show(left + later * self._training)
