"""Times beside a probe of what the machine gave at that moment: on a shared machine a time alone means nothing."""

from __future__ import annotations

import ctypes
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
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
    spread: float = 0.0  # distance between the quartiles


@dataclass(frozen=True)
class Probe:
    """What the library's threads could do: multiply-adds (2 flops each) and copying (bytes read + bytes written)."""

    fma_gflops: float
    copy_gb_s: float

    def better(self, other: Probe) -> Probe:
        """The larger of each rate: interruptions only ever make a probe smaller."""
        return Probe(max(self.fma_gflops, other.fma_gflops), max(self.copy_gb_s, other.copy_gb_s))


def summary(times_ms: Sequence[float]) -> Timing:
    """Median, minimum and interquartile distance of repeated times."""
    low, high = np.percentile(times_ms, (25, 75))
    return Timing(statistics.median(times_ms), min(times_ms), len(times_ms), float(high - low))


def measure(work: Callable[[], object], *, repeats: int, warmup: int = 5) -> Timing:
    """Time a function."""
    for _ in range(warmup):
        work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return summary(times)


def _rate(library: Library, name: str, *, scales: bool) -> float:
    """The best of three on all threads; also, where ``scales``, of the best of three on one thread times the threads.

    A neighbour on the machine takes a core away for seconds, and then no probe on all threads sees the peak, though a
    short kernel between two interruptions reaches it.
    """
    function, threads = library.function(name, ctypes.c_double, []), library.threads
    best = max(function() for _ in range(3))
    if scales and threads > 1:
        library.use_threads(1)
        best = max(best, threads * max(function() for _ in range(3)))
        library.use_threads(threads)
    return best


def peak_probe(library: Library) -> float:
    """GFLOP/s of fused multiply-adds that the library's threads can reach with a core each, at today's clock.

    Compare it with the same figure of another run before comparing times.
    """
    return _rate(library, "gs2d_probe_fma", scales=True)


def probe(library: Library) -> Probe:
    """Both rates right now. Copying is not scaled: the cores share the memory."""
    return Probe(peak_probe(library), _rate(library, "gs2d_probe_copy", scales=False))


def machine() -> dict[str, str | int]:
    """What the numbers were measured on."""
    model, count = platform.processor() or platform.machine(), 0
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model, count = names[0] if names else model, len(names)
    try:
        own = version("2dgs-r")
    except PackageNotFoundError:
        own = "source checkout"
    return {
        "cpu": model,
        "cores": count,
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "2dgs-r": own,
    }
