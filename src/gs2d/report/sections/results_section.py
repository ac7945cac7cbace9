"""Quality, size and cost of each stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup

from gs2d.config.grades import TRANSPARENT
from gs2d.report.html_parts import macro, missing
from gs2d.report.run_record import RunRecord, number
from gs2d.report.sections.section_registry import register_section

_SPLITS = {
    "test": "new views",
    "test_matched": "new views, colours matched to the photograph",
    "test_aligned": "new views, cameras aligned with the photograph",
    "train": "training views",
}
_METRICS = (("psnr", "PSNR, dB", 2, 1), ("ssim", "SSIM", 4, 1), ("lpips", "LPIPS", 4, -1))
_COSTS: tuple[tuple[str, int, Callable[[Mapping[str, Any]], float | None]], ...] = (
    ("Iterations", 0, lambda stage: number(stage.get("iterations"))),
    ("Splats", 0, lambda stage: number(stage.get("splats"))),
    ("Size, MB", 1, lambda stage: _scaled(stage.get("bytes"), 1e-6)),
    ("Time, s", 0, lambda stage: number(stage.get("seconds"))),
    ("Peak memory, MB", 0, lambda stage: _scaled(stage.get("peak_memory_bytes"), 1e-6)),
)


@register_section("results", title="Results")
def results_section(run: RunRecord) -> str | None:
    """Return a table with one row per figure and one column per stage; figures that no stage has are left out."""
    if not run.stages:
        return missing("No stage is finished yet.")
    rows: list[list[str]] = []
    best: list[tuple[int, int]] = []
    for split, words in _SPLITS.items():
        for key, label, digits, sign in _METRICS:
            values = [number((stage.get(split) or {}).get(key)) for stage in run.stages]
            signed = [sign * value for value in values if value is not None]
            if not signed:
                continue
            if len(signed) > 1:
                best += [(len(rows), 1 + k) for k, value in enumerate(values) if value == sign * max(signed)]
            rows.append([f"{label} ({words})", *(figure(value, digits) for value in values)])
    for label, digits, cost in _COSTS:
        values = [cost(stage) for stage in run.stages]
        if any(value is not None for value in values):
            rows.append([label, *(figure(value, digits) for value in values)])
    columns = ["", *(_stage_name(stage) for stage in run.stages)]
    return macro("macros.html", "table", columns, rows, best=best) + _transparent(run)


def _transparent(run: RunRecord) -> Markup:
    """Return a line about transparent pixels; empty if there are few, or they were not counted."""
    counted = run.last.get("transparent")
    if not counted or counted["part"] <= TRANSPARENT:
        return Markup("")
    return missing(
        f"Transparent: in {100 * counted['part']:.1f} % of the pixels of training views the background shows through "
        f"(alpha below 0.9), most in {counted['view']} ({100 * counted['worst']:.1f} %). The mesh may have holes there."
    )


def figure(value: float | None, digits: int) -> str:
    """Return a number with fixed digits, or a dash for None."""
    return "-" if value is None else f"{value:,.{digits}f}"


def _scaled(value: Any, factor: float) -> float | None:
    amount = number(value)
    return None if amount is None else amount * factor


def _stage_name(stage: Mapping[str, Any]) -> str:
    source = stage.get("reused_from")  # a file of the stage cache, or a run; metrics.json has the whole path
    return f"{stage['name']} (reused from {Path(source).name[:12]})" if source else str(stage["name"])
