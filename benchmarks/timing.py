"""Time functions together with a probe of the machine's current speed, which is needed to compare times on shared
hosts.
"""

from __future__ import annotations

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
    spread: float = 0.0  # interquartile range


@dataclass(frozen=True)
class Probe:
    """Rates that the library's threads can reach: multiply-adds (2 flops each) and copying (bytes read + bytes
    written).
    """

    fma_gflops: float
    copy_gb_s: float

    def better(self, other: Probe) -> Probe:
        """Return the larger of each rate: interruptions only ever reduce a probe."""
        return Probe(max(self.fma_gflops, other.fma_gflops), max(self.copy_gb_s, other.copy_gb_s))


def summary(times_ms: Sequence[float]) -> Timing:
    """Return median, minimum and interquartile range of repeated times."""
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
    """Return the best of three rates on all threads; if ``scales``, also consider one thread's rate times the threads.

    Other load on the machine can occupy a core for seconds. A probe on all threads then misses the peak, although a
    short kernel between two interruptions reaches it.
    """
    threads = library.threads
    best = max(library.call(name) for _ in range(3))
    if scales and threads > 1:
        library.use_threads(1)
        best = max(best, threads * max(library.call(name) for _ in range(3)))
        library.use_threads(threads)
    return best


def peak_probe(library: Library) -> float:
    """Return the GFLOP/s of fused multiply-adds that the library's threads can reach with a core each, at the current
    clock.

    Compare this figure between runs before comparing times.
    """
    return _rate(library, "gs2d_probe_fma", scales=True)


def probe(library: Library) -> Probe:
    """Measure both rates now. Copying is not scaled: the cores share the memory."""
    return Probe(peak_probe(library), _rate(library, "gs2d_probe_copy", scales=False))


def machine() -> dict[str, str | int]:
    """Return the hardware and software that the numbers were measured on."""
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
