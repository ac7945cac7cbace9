"""Sample the Python stack of the main thread every few milliseconds to attribute wall time.

Native code counts for the Python function that called it. The sampled code is not instrumented.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

PERIOD = 0.004  # s
SWITCH = 0.001  # s that Python code may run before the sampler gets the GIL

Place = tuple[str, str]  # end of the file's path, function ("" = any)


@dataclass(frozen=True)
class Rule:
    """Rule that assigns stacks with one of these frames to ``name``; the innermost frame wins, then the first rule."""

    name: str
    places: tuple[Place, ...]

    def holds(self, file: str, function: str) -> bool:
        """Return True if a frame is one of ``places``."""
        return any(file.endswith(end) and name in ("", function) for end, name in self.places)


@dataclass
class Seconds:
    """Seconds by phase and by part in each phase; ``deepest`` lists functions of samples without a part."""

    phases: dict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(lambda: defaultdict(float)))
    deepest: dict[str, float] = field(default_factory=lambda: defaultdict(float))


def frames(frame: FrameType | None) -> Iterator[FrameType]:
    """Yield (file, function) from the innermost frame outwards."""
    while frame is not None:
        yield frame
        frame = frame.f_back


def classify(stack: Sequence[tuple[str, str]], rules: Sequence[Rule]) -> str | None:
    """Return the rule of a stack of (file, function), innermost first."""
    for file, function in stack:
        for rule in rules:
            if rule.holds(file, function):
                return rule.name
    return None


class Sampler:
    """Sampler of the thread that enters the context, until it leaves.

    Parameters
    ----------
    phases, parts : sequence of Rule
        Every sample has one of each, or "other".
    """

    def __init__(self, phases: Sequence[Rule], parts: Sequence[Rule]) -> None:
        self.phases, self.parts, self.seconds = phases, parts, Seconds()
        self._watched = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._switch = sys.getswitchinterval()

    def __enter__(self) -> Seconds:
        self._watched = threading.get_ident()
        sys.setswitchinterval(SWITCH)
        self._thread.start()
        return self.seconds

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        sys.setswitchinterval(self._switch)

    def _run(self) -> None:
        last = time.perf_counter()
        while not self._stop.wait(PERIOD):
            frame = sys._current_frames().get(self._watched)
            now = time.perf_counter()
            self.add([(f.f_code.co_filename, f.f_code.co_name) for f in frames(frame)], now - last)
            last = now

    def add(self, stack: Sequence[tuple[str, str]], elapsed: float) -> None:
        """Count one sample."""
        part = classify(stack, self.parts)
        self.seconds.phases[classify(stack, self.phases) or "other"][part or "other"] += elapsed
        if part is None and stack:
            self.seconds.deepest[f"{stack[0][0].rsplit('/', 1)[-1]}:{stack[0][1]}"] += elapsed


@dataclass
class Cost:
    """Cost of one part of one phase."""

    wall: float = 0.0  # s
    cpu: float = 0.0  # s, of all threads of the process
    rss: int = 0  # bytes, peak resident memory


class CostSampler:
    """Sampler of the entering thread's position, with CPU time and resident memory of the process.

    Parameters
    ----------
    phases, parts : sequence of Rule
        Every sample has one of each, or "other".
    """

    def __init__(self, phases: Sequence[Rule], parts: Sequence[Rule]) -> None:
        self.phases, self.parts = phases, parts
        self.costs: dict[str, dict[str, Cost]] = defaultdict(lambda: defaultdict(Cost))
        self._watched = threading.get_ident()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> dict[str, dict[str, Cost]]:
        self._thread.start()
        return self.costs

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        wall, cpu = time.perf_counter(), time.process_time()
        while not self._stop.wait(PERIOD):
            frame = sys._current_frames().get(self._watched)
            now, used = time.perf_counter(), time.process_time()
            stack = [(f.f_code.co_filename, f.f_code.co_name) for f in frames(frame)]
            self.add(stack, now - wall, used - cpu, resident_bytes())
            wall, cpu = now, used

    def add(self, stack: Sequence[tuple[str, str]], wall: float, cpu: float, rss: int) -> None:
        """Count one sample."""
        phase, part = classify(stack, self.phases) or "other", classify(stack, self.parts) or "other"
        cost = self.costs[phase][part]
        cost.wall, cost.cpu, cost.rss = cost.wall + wall, cost.cpu + cpu, max(cost.rss, rss)


def resident_bytes() -> int:
    """Return the resident memory of this process (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
