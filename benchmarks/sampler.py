"""Where the wall time of the main thread goes: its Python stack, looked at every few milliseconds from another thread.

Native code counts for the Python function that called it. Nothing is instrumented, so what runs is what users run.
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
SWITCH = 0.001  # s that Python code may run before the sampler gets its turn

Place = tuple[str, str]  # end of the file's path, function ("" = any)


@dataclass(frozen=True)
class Rule:
    """A stack with one of these places in it belongs to ``name``; the innermost place decides, then the first rule."""

    name: str
    places: tuple[Place, ...]

    def holds(self, file: str, function: str) -> bool:
        """Whether a frame is one of the places."""
        return any(file.endswith(end) and name in ("", function) for end, name in self.places)


@dataclass
class Seconds:
    """Seconds by phase, and in each by part; ``deepest`` by function where no part was found."""

    phases: dict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(lambda: defaultdict(float)))
    deepest: dict[str, float] = field(default_factory=lambda: defaultdict(float))


def frames(frame: FrameType | None) -> Iterator[FrameType]:
    """From the innermost frame out."""
    while frame is not None:
        yield frame
        frame = frame.f_back


def classify(stack: Sequence[tuple[str, str]], rules: Sequence[Rule]) -> str | None:
    """The rule of a stack of (file, function), innermost first."""
    for file, function in stack:
        for rule in rules:
            if rule.holds(file, function):
                return rule.name
    return None


class Sampler:
    """Samples the thread that enters it until it leaves.

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
    """What one part of one phase took."""

    wall: float = 0.0  # s
    cpu: float = 0.0  # s, of all threads of the process
    rss: int = 0  # bytes, the most that were resident at once


class CostSampler:
    """Samples where the thread that enters it is, what the whole process used meanwhile, and how large it is.

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
    """Resident memory of this process now (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
