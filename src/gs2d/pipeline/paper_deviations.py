"""In what a table differs from the paper's, in sentences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from gs2d.paper_tables import METRICS, NERF_SYNTHETIC, SCENES, PaperTable
from gs2d.pipeline.paper_rows import Results
from gs2d.pipeline.paper_scenes import FoundScene, missing_scenes

if TYPE_CHECKING:
    from gs2d.pipeline.paper import PaperOptions


def deviations_of(
    options: PaperOptions, scenes: Sequence[FoundScene], table: PaperTable, results: Results
) -> list[str]:
    """Every difference that is known, the most important first."""
    found = []
    if options.schedule_scale != 1.0:
        found.append(f"the schedule is {options.schedule_scale:g} of the paper's (30k + 10k + 20k iterations)")
    for scene in scenes:
        factor = options.downscale or scene.protocol.downscale
        if factor != scene.protocol.downscale:
            found.append(
                f"{scene.name}: photographs shrunk by {factor}, the protocol {scene.protocol.name} says "
                f"{scene.protocol.downscale}"
            )
    for data_set, absent in missing_scenes(scenes).items():
        found.append(
            f"{data_set}: {len(absent)} of the paper's {len(SCENES[data_set])} scenes missing: {', '.join(absent)}"
        )
    for data_set in dict.fromkeys(scene.data_set for scene in scenes):
        if data_set not in table.columns:
            which = ", ".join(scene.name for scene in scenes if scene.data_set == data_set)
            found.append(
                f"{which}: not a data set of this table ({', '.join(table.columns)}): no figures of the paper beside"
            )
    found += [f"changed in the recipes: {text}" for text in options.overrides]
    found += _missing_figures(results)
    if any(scene.data_set == NERF_SYNTHETIC and scene.truth for scene in scenes):
        found.append("F-score on NeRF-Synthetic is by this project's own protocol: the paper states none")
    seeds, names = len(options.seeds), ", ".join(map(str, options.seeds))
    found.append(f"{seeds} seed{'s' if seeds > 1 else ''} ({names}); the paper does not say how many")
    return found


def _missing_figures(results: Results) -> list[str]:
    """Failed runs, and figures that nothing has."""
    found, told = [], set()
    for row in results.rows:
        for cell in row.cells:
            if cell.figures["psnr"] is None and (reason := cell.reasons.get("psnr")):
                text = f"{cell.scene}, seed {cell.seed}: no figures ({reason})"
                if (row.recipe, text) not in told:
                    told.add((row.recipe, text))
                    found.append(f"{row.name}, {text}")
    for data_set in results.data_sets:
        for metric in ("lpips", "chamfer" if data_set == "DTU" else "fscore"):
            reasons = {
                cell.reasons.get(metric, "")
                for row in results.rows
                for cell in row.of(data_set)
                if cell.figures[metric] is None and cell.figures["psnr"] is not None
            }
            if reasons:
                found.append(
                    f"{data_set}: {METRICS[metric]} is missing for some or all runs ({'; '.join(sorted(reasons))})"
                )
    return found
