"""Medians beside a probe of what the machine gave at that moment: on a shared machine a time alone means nothing."""

from __future__ import annotations

import ctypes
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from gs2d.kernels.library import Library


@dataclass(frozen=True)
class Timing:
    """Milliseconds of one measurement."""

    median: float
    best: float
    repeats: int


def measure(work: Callable[[], object], *, repeats: int, warmup: int = 5) -> Timing:
    """Time a function."""
    for _ in range(warmup):
        work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return Timing(statistics.median(times), min(times), repeats)


def peak_probe(library: Library) -> float:
    """GFLOP/s of fused multiply-adds on the library's threads right now, the better of three.

    Compare it with the same figure of a quiet machine before comparing times.
    """
    rate = library.function("gs2d_probe_fma", ctypes.c_double, [])
    return max(rate() for _ in range(3))


def machine() -> dict[str, str]:
    """What the numbers were measured on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = f"{len(names)} x {names[0]}" if names else model
    return {
        "processor": model,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
    }
