"""Decide whether one results file is slower than another by more than noise.

A step regresses when both its median and its best time, in units of the machine, grow by more than the limit:

    growth = (time_B x probe_B) / (time_A x probe_A)        probe: the rate measured in the same run
    limit  = 1 + max(0.10, 2 x (spread_A / median_A + spread_B / median_B))

The probe is the copy rate for memory-bound steps (``MEMORY_STEPS``) and the multiply-add rate for the others. Both
times must grow, so that neither an interruption (which moves medians) nor a lucky sample (which moves minima) decides
alone. Steps below 0.2 ms in both files are ignored. Memory per splat has no noise: an increase of more than 1 % is a
regression. Files with different instruction sets or thread counts, or without a common workload, cannot be compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

MEMORY_STEPS = frozenset({"sort", "bin", "index_slots", "optimizer", "densification"})
MIN_GROWTH, SPREADS, MIN_MS = 0.10, 2.0, 0.2
MEMORY_GROWTH = 0.01


class NotComparable(Exception):
    """Raised if the two files do not measure the same thing."""


@dataclass(frozen=True)
class Change:
    """One figure of both files, in machine units."""

    workload: str
    step: str
    growth: float  # the smaller growth of median and best
    limit: float

    @property
    def regressed(self) -> bool:
        """Return True if the growth exceeds noise."""
        return self.growth > self.limit

    def __str__(self) -> str:
        verdict = "REGRESSION" if self.regressed else "ok"
        return f"{self.workload:24} {self.step:18} x {self.growth:.3f} (limit {self.limit:.3f}) {verdict}"


def _steps(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[tuple[str, str, float, float]]:
    """Yield each step with its field prefix and the probes of both files."""
    for step in a["ms"]:
        key = "copy_gb_s" if step in MEMORY_STEPS else "fma_gflops"
        if step in b["ms"]:
            yield step, "", a["probe"][key], b["probe"][key]
    for step, rate in a["iteration_fma_gflops"].items():
        if step in b["iteration_fma_gflops"]:
            yield step, "iteration_", rate, b["iteration_fma_gflops"][step]


def _judge(name: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[Change]:
    for step, prefix, probe_a, probe_b in _steps(a, b):
        median_a, median_b = a[f"{prefix}ms"][step], b[f"{prefix}ms"][step]
        if max(median_a, median_b) < MIN_MS:
            continue
        best_a, best_b = a[f"{prefix}best_ms"][step], b[f"{prefix}best_ms"][step]
        noise = sum(x[f"{prefix}spread_ms"][step] / max(median, 1e-9) for x, median in ((a, median_a), (b, median_b)))
        growths = [probe_b * y / (probe_a * max(x, 1e-6)) for x, y in ((median_a, median_b), (best_a, best_b))]
        yield Change(name, step, min(growths), 1.0 + max(MIN_GROWTH, SPREADS * noise))
    yield Change(name, "bytes_per_splat", b["bytes_per_splat"] / a["bytes_per_splat"], 1.0 + MEMORY_GROWTH)


def compare(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[Change]:
    """Return the changes from file A to file B, workload by workload.

    Raises
    ------
    NotComparable
        If the format, instruction set or number of threads differ, or there is no common workload.
    """
    for key, one, two in (
        ("format", a.get("format"), b.get("format")),
        *((k, a["machine"].get(k), b["machine"].get(k)) for k in ("variant", "threads")),
    ):
        if one != two:
            raise NotComparable(f"{key} must be the same in both files, got {one} and {two}")
    common = [name for name in a["workloads"] if name in b["workloads"]]
    if not common:
        raise NotComparable("the files have no workload in common; run both with the same options")
    return [change for name in common for change in _judge(name, a["workloads"][name], b["workloads"][name])]
