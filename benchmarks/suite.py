"""Run all workloads, stage by stage and with whole iterations, and return one JSON document."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import torch

from benchmarks.flops import EXECUTED, USEFUL, fraction
from benchmarks.iteration import iteration_times
from benchmarks.memory import view_bytes
from benchmarks.stages import measure_stages
from benchmarks.timing import machine
from benchmarks.workload import Workload
from gs2d.kernels.library import Library, load

FORMAT = 1
DIGITS = 4  # significant digits of every figure


def rounded(value: float) -> float:
    """Round to four significant digits."""
    return float(f"{value:.{DIGITS}g}")


def workload_result(library: Library, workload: Workload, seconds: float, least: int) -> dict[str, Any]:
    """Return one entry of ``workloads``. Times in ms; fractions use the best times and the best probe (see docs)."""
    measured = measure_stages(library, workload, seconds, least)
    steps, work, peak = measured.steps, measured.work, measured.probe
    repeats = max(least, min(30, round(1e3 * seconds / max(steps["raster_backward"].median * 2, 1.0))))
    iterations = iteration_times(workload, library, repeats)
    stages = {f"stage{index + 1}": row.timing for index, row in enumerate(iterations.values())}

    def fraction_of_peak(flops: dict[str, int]) -> dict[str, float]:
        best = {name: steps[f"blend_{name}"].best for name in flops}
        return {n: rounded(fraction(flops[n], work.pairs, best[n], peak.fma_gflops)) for n in flops}

    return {
        "splats": work.splats,
        "width": work.width,
        "height": work.height,
        "ms": {name: rounded(timing.median) for name, timing in steps.items()},
        "best_ms": {name: rounded(timing.best) for name, timing in steps.items()},
        "spread_ms": {name: rounded(timing.spread) for name, timing in steps.items()},
        "repeats": {name: timing.repeats for name, timing in steps.items()},
        "iteration_ms": {name: rounded(timing.median) for name, timing in stages.items()},
        "iteration_best_ms": {name: rounded(timing.best) for name, timing in stages.items()},
        "iteration_spread_ms": {name: rounded(timing.spread) for name, timing in stages.items()},
        "iteration_fma_gflops": {
            f"stage{index + 1}": rounded(row.fma_gflops) for index, row in enumerate(iterations.values())
        },
        "iteration_page_faults": {
            f"stage{index + 1}": round(row.page_faults, 1) for index, row in enumerate(iterations.values())
        },
        "stage2_fill_ms_by_view": rounded(iterations["appearance"].extra_ms_of_first_by_view),
        "fma_fraction": fraction_of_peak(USEFUL),
        "fma_fraction_executed": fraction_of_peak(EXECUTED),
        "probe": {name: rounded(value) for name, value in asdict(peak).items()},
        "bytes_per_splat": rounded(measured.frame_bytes / work.splats),
        "memory": {"frame_bytes": measured.frame_bytes, "predicted_bytes": view_bytes(work)},
        "work": asdict(work)
        | {
            "pairs_per_pixel": rounded(work.pairs / (work.width * work.height)),
            "lane_use": rounded(work.pairs / max(work.lane_pairs, 1)),
        },
    }


def run_suite(
    workloads: Sequence[Callable[[], Workload]],
    *,
    threads: int,
    seconds: float,
    least: int,
    on_result: Callable[[str, dict[str, Any]], None] = lambda name, document: None,
    variant: str | None = None,
) -> dict[str, Any]:
    """Measure every workload on ``threads`` threads; restore torch's number of threads afterwards.

    ``on_result`` gets the name of each finished workload and the document at that point.
    """
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        library = load(variant)
        library.use_threads(threads)
        document: dict[str, Any] = {
            "format": FORMAT,
            "date": time.strftime("%Y-%m-%d"),
            "machine": machine() | {"variant": library.variant, "lanes": library.lanes, "threads": threads},
            "flops_per_visible_pair": USEFUL,
            "flops_executed_per_visible_pair": EXECUTED,
            "workloads": {},
        }
        for make in workloads:
            workload = make()
            document["workloads"][workload.name] = workload_result(library, workload, seconds, least)
            on_result(workload.name, document)
    finally:
        torch.set_num_threads(before)
    return document
