"""How far the whole run is, and between how many seconds it will last: from what its events told so far."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from gs2d.pipeline.events import Expected, Part, Phase, Plan, duration

SPREAD = 2.0  # by what a share of training that was measured elsewhere may be wrong, either way
GROWTH = 1.5  # training gets slower while splats are added: what is left may cost so many times more than expected
GREW = (2.0, 60.0)  # an estimate of more than so many times what is shown and so many s: the work grew
_TRAINING = "training"


@dataclass(frozen=True)
class Left:
    """Seconds that are left, between two bounds."""

    least: float
    most: float

    def __add__(self, other: Left) -> Left:
        return Left(self.least + other.least, self.most + other.most)


class Countdown:
    """The seconds left as they are shown: they do not rise, unless the work grew."""

    def __init__(self) -> None:
        self._shown = Left(math.inf, math.inf)

    def show(self, left: Left) -> Left:
        """Take up a new estimate, and return what to show."""
        if left.most <= GREW[0] * self._shown.most + GREW[1]:
            left = Left(min(left.least, self._shown.least), min(left.most, self._shown.most))
        self._shown = left
        return left


class WholeRun:
    """Follows the events of a run that said of what it consists."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._parts: tuple[Part, ...] = ()
        self._now = -1  # index of the part; -1: before the first
        self._began = 0.0  # clock, of the part
        self._phase: Phase | None = None  # the last one of the part's own
        self._phase_began = 0.0
        self._done = 0
        self._own = False  # whether the phase that runs is the part's own
        self._training: Left | None = None  # all of it
        self._shown = Countdown()

    def on_plan(self, plan: Plan) -> None:
        """Take up a plan; one that is a part of the plan before says nothing new, the same one is another run."""
        if not set(plan.parts) < set(self._parts):
            self._parts, self._now, self._phase, self._training = plan.parts, -1, None, None
            self._shown = Countdown()

    def on_expected(self, expected: Expected) -> None:
        """Hear how long training will take."""
        self._training = Left(expected.least, expected.most)

    def on_phase(self, phase: Phase) -> None:
        """Go to the part that a phase begins; most phases are in the part that runs already."""
        for index in range(max(self._now, 0), len(self._parts)):
            if phase.name.startswith(self._parts[index].begins):
                if index != self._now:
                    self._now, self._began, self._phase = index, self._clock(), None
                if self._phase is None or self._phase.name != phase.name:
                    self._phase, self._phase_began = phase, self._clock()
                self._done, self._own = phase.done, True
                return
        self._own = False

    def on_step(self, done: int) -> None:
        """Count a step, if it is one of the part's own."""
        if self._own:
            self._done = done
            left = self._left_of_this()
            if self._is_training and left is not None:
                spent = self._clock() - self._began
                self._training = left + Left(spent, spent)

    def line(self) -> str:
        """Return "part 5 of 7: training; whole run: 6 to 14 min left", or nothing where there is no plan."""
        if self._now < 0 or len(self._parts) < 2:
            return ""
        text = f"part {self._now + 1} of {len(self._parts)}: {self._parts[self._now].name}"
        left = self.left()
        if left is not None:
            return f"{text}; whole run: {between(left)} left"
        known_later = any(part.name == _TRAINING for part in self._parts[self._now + 1 :])
        return f"{text}; whole run: known once training begins" if known_later else text

    def left(self) -> Left | None:
        """Return the seconds until the run ends, which do not rise; None where nobody can tell yet."""
        if self._now < 0:
            return None
        left = self._left_of_this()
        for part in self._parts[self._now + 1 :]:
            later = self._expected(part)
            if left is None or later is None:
                return None
            left = left + later
        return None if left is None else self._shown.show(left)

    @property
    def _is_training(self) -> bool:
        return self._parts[self._now].name == _TRAINING

    def _left_of_this(self) -> Left | None:
        """Seconds left of the part that runs: by its own steps, else by what was expected of it."""
        spent = self._clock() - self._began
        if self._phase is not None and self._phase.total and self._phase.name.startswith(self._parts[self._now].begins):
            fraction = (self._done - self._phase.done) / max(self._phase.total - self._phase.done, 1)
            seconds = self._phase.seconds_left(self._done, self._clock() - self._phase_began)
            if seconds is not None:
                growth = 1 + (GROWTH - 1) * (1 - fraction) if self._is_training else 1.0
                return Left(seconds, seconds * growth)
        expected = self._expected(self._parts[self._now])
        if expected is None or expected.most <= spent:  # longer than it should take: nobody can tell
            return None
        return Left(max(expected.least - spent, 0.0), expected.most - spent)

    def _expected(self, part: Part) -> Left | None:
        if part.name == _TRAINING:
            return self._training
        if part.of_training is None or self._training is None:
            return None
        share = part.of_training
        return Left(self._training.least * share / SPREAD, self._training.most * share * SPREAD)


def between(left: Left) -> str:
    """Return two bounds as people say them: "about 4 min", "4 to 9 min", "50 s to 3 min"."""
    least, most = duration(left.least), duration(left.most)
    if left.most < 1.3 * left.least or least == most:
        return f"about {most}"
    number, _, unit = least.partition(" ")
    return f"{number} to {most}" if most.endswith(f" {unit}") else f"{least} to {most}"
