"""Curves of the training."""

from __future__ import annotations

import math

from gs2d.report.html_parts import macro, missing
from gs2d.report.plots import curves, read_history
from gs2d.report.run_record import RunRecord, number
from gs2d.report.sections.section_registry import register_section


@register_section("training", title="Training curves")
def training_section(run: RunRecord) -> str | None:
    """Return the curves of ``events.jsonl``."""
    scores = {stage["name"]: number((stage.get(run.split) or {}).get("psnr")) for stage in run.stages}
    ends = {name: float(psnr) for name, psnr in scores.items() if psnr is not None and math.isfinite(psnr)}
    drawn = curves(read_history(run.events), ends, run.split)
    if not drawn:
        return missing("events.jsonl holds no training steps: there are no curves.")
    return macro("lists.html", "curves", drawn)
