"""Sentences on differences between a table and that of the paper, and on its figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from gs2d.config.presets import get_recipe
from gs2d.config.recipe import GradDensify
from gs2d.config.schedule import scale_schedule
from gs2d.contrib.lab.aggregate import NOT_YET, Results, surface_metric
from gs2d.contrib.lab.lab_options import SweepOptions
from gs2d.contrib.lab.paper_tables import DTU, METRICS, NERF_SYNTHETIC, TNT, PaperTable
from gs2d.contrib.lab.scenes import SweepScene, missing_scenes, unreadable
from gs2d.data.image_files import image_size
from gs2d.errors import Gs2dError
from gs2d.io.run_dir import machine, versions

NERF_SYNTHETIC_SIZE = (800, 800)  # px
SHOWN_PIECES = 5  # missing files listed for each capture
OFFICIAL_EVALUATORS = {DTU: "dtu", TNT: "tnt"}  # evaluators of the paper's surfaces, by data set


def deviations_of(
    options: SweepOptions, scenes: Sequence[SweepScene], table: PaperTable, results: Results
) -> list[str]:
    """Return the known differences, the most important first."""
    lines = []
    if options.schedule_scale != 1.0:
        lines.append(f"the schedule is {options.schedule_scale:g} of the paper's (30k + 10k + 20k iterations)")
        full, scaled = opacity_resets(1.0), opacity_resets(options.schedule_scale)
        if full != scaled:
            lines.append(
                f"opacity is reset {scaled} times in stage 1, in the paper {full} times: the interval is not scaled"
            )
        points = [scale_schedule(get_recipe("2dgs"), scale).init_points for scale in (1.0, options.schedule_scale)]
        if points[0] != points[1]:
            lines.append(f"captures without points start from {points[1]:,} random ones, not from {points[0]:,}")
    lines += _scenes(options, scenes, table)
    lines += [f"changed in the recipes: {text}" for text in options.overrides]
    if table.of_paper:
        lines += _methods(table, scenes)
        lines += _weights(table, scenes)
    lines += _missing_figures(results)
    if any(scene.data_set == NERF_SYNTHETIC and scene.scored for scene in scenes):
        lines.append(
            "F-score on NeRF-Synthetic is by this project's own protocol, at 0.25 % of the true diagonal: the paper "
            "states none"
        )
    lines += dict.fromkeys(_surfaces(results))
    if options.slots is not None and options.slots > 1:
        lines.append(f"{options.slots} runs shared the machine: their seconds are longer than those of one alone")
    count, names = len(options.seeds), ", ".join(map(str, options.seeds))
    unsaid = "; the paper does not say how many" if table.of_paper else ""
    lines.append(f"{count} seed{'s' if count > 1 else ''} ({names}){unsaid}")
    host, installed = machine(), versions()
    backends = ", ".join(
        sorted({cell.details["backend"] for row in results.rows for cell in row.cells if cell.details})
    )
    lines.append(
        f"machine: {host['processor']}, {host['cores']} cores, backend {backends or 'none yet'}"
        f"{' (paper: RTX 4090)' if table.of_paper else ''}; "
        f"gs2d {installed['2dgs-r']}, torch {installed['torch']}, Python {installed['python']}"
    )
    return lines


def opacity_resets(scale: float) -> int:
    """Return the number of opacity resets of stage 1 at a fraction of the schedule, over black."""
    stage = scale_schedule(get_recipe("2dgs"), scale).stages[0]
    assert isinstance(stage.densify, GradDensify)
    return sum(stage.densify.resets(i, white=False) for i in range(1, stage.iterations + 1))


def _methods(table: PaperTable, scenes: Sequence[SweepScene]) -> Iterator[str]:
    """Yield details that the paper leaves open, and intended differences of gs2d."""
    yield (
        "the rasterizer is gs2d's own and departs from the official one in pixel centres, footprint, and depth where "
        "the low-pass filter wins: docs/notebook/rasterizer.md"
    )
    if any(scene.protocol.near_plane_policy == "cull" for scene in scenes):
        yield (
            "splats that reach the camera plane are left out of that view, where the official rasterizer draws a part "
            "of them: docs/notebook/rasterizer.md"
        )
    if any(scene.protocol.near_plane_policy != "draw" for scene in scenes):
        yield (
            "splats that no training view sees, among them all with an opacity below 1/255, are dropped at the end of "
            "a stage, so rows with free and with frozen opacity differ in storage: docs/notebook/rasterizer.md"
        )
    if any(scene.data_set == DTU for scene in scenes):
        yield (
            "DTU: distortion has no weight but where a row names one, as in the paper's Table 1 (the official DTU "
            "script has 1000); image figures are of whole photographs, with their background (the paper does not say)"
        )
    recipes = {row.recipe: get_recipe(row.recipe) for row in table.trained if row.recipe is not None}
    if any(len(recipe.stages) > 2 for recipe in recipes.values()):
        yield (
            "the paper does not say which pixels count in E_i, with what opacity clones begin, nor the rates and "
            "Adam's moments of stages 2 and 3: docs/notebook/training.md has the readings that were trained"
        )
    if "2dgs-r-absgs-a" in recipes:
        yield (
            "the paper prints no thresholds of AbsGS-A: those here are gs2d's own (docs/guides/paper.md); AbsGS-D has "
            "those of AbsGS's released code, and both densify in stage 3 in place of the clone"
        )


def _weights(table: PaperTable, scenes: Sequence[SweepScene]) -> Iterator[str]:
    """Yield scenes whose protocol sets a distortion weight other than the paper's "100/10"."""
    if not any("100/10" in row.name for row in table.rows):
        return
    weighed = [(s.name, s.protocol.loss_weights["distortion"]) for s in scenes if s.data_set != TNT]
    for weight in dict.fromkeys(weight for _, weight in weighed):
        names = ", ".join(name for name, value in weighed if value == weight)
        yield f"{names}: alpha with distortion is {weight:g}, their protocol's; the paper's 100/10 is of TnT"


def _surfaces(results: Results) -> Iterator[str]:
    """Yield surfaces with another protocol than in the paper, and warnings of their self-checks."""
    doubts: dict[tuple[str, str], list[str]] = {}
    odd: dict[str, Sequence[str]] = {}  # once per scene
    for row in results.rows:
        for cell in row.cells:
            surface = cell.details.get("surface") or {}
            official = OFFICIAL_EVALUATORS.get(cell.data_set)
            if official is not None and surface.get("evaluator", official) != official:
                yield (
                    f"{cell.scene}: its surface is scored by this project's visible-surface protocol, not by that of "
                    f"{cell.data_set}; do not compare it with the paper's"
                )
            check = surface.get("self_check") or {"ok": True}
            messages = check.get("messages") or ()
            if check["ok"] and messages:
                odd.setdefault(cell.scene, messages)
            if not check["ok"]:
                why = "; ".join(messages) or surface.get("reason") or "no reason given"
                doubts.setdefault((cell.scene, why), []).append(f"{row.name} (seed {cell.seed})")
    yield from (f"{scene}: {message}" for scene, messages in odd.items() for message in messages)
    for (scene, why), runs in doubts.items():
        yield f"{scene}: do not believe the surface scores of {', '.join(runs)}: {why}"


def _scenes(options: SweepOptions, scenes: Sequence[SweepScene], table: PaperTable) -> Iterator[str]:
    """Return differences in images and scenes, and missing files."""
    if table.of_paper:
        yield from _other_scenes(scenes, table)
    for scene in scenes:
        factor = options.downscale or scene.downscale
        if factor != scene.downscale:
            yield f"{scene.name}: photographs shrunk by {factor}, its protocol says {scene.downscale}"
        size = _size(scene)
        if scene.data_set == NERF_SYNTHETIC and size is not None and size != NERF_SYNTHETIC_SIZE:
            yield (
                f"{scene.name}: photographs of {size[0]}x{size[1]} px, the data set has 800x800; small ones overstate "
                "what normal consistency costs: docs/notebook/rasterizer.md"
            )
        yield from (f"{scene.name}: {line}" for line in scene.missing[:SHOWN_PIECES])
        if len(scene.missing) > SHOWN_PIECES:
            more = len(scene.missing) - SHOWN_PIECES
            yield f"{scene.name}: {more} more pieces are missing; about.json names each"
    if not options.scenes:
        yield from (f"{name} is not trained: {line}" for name, line in unreadable(options.data).items())


def _other_scenes(scenes: Sequence[SweepScene], table: PaperTable) -> Iterator[str]:
    """Yield scenes that are not in the paper, and missing scenes of its data sets."""
    for data_set in dict.fromkeys(scene.data_set for scene in scenes):
        if data_set not in table.columns:
            names = ", ".join(scene.name for scene in scenes if scene.data_set == data_set)
            yield f"trained on {names} ({data_set}); the paper's table is of {', '.join(table.columns)}"
    for data_set, (absent, count) in missing_scenes(scenes).items():
        yield f"{data_set}: {len(absent)} of its {count} scenes are not here: {', '.join(absent)}"


def _size(scene: SweepScene) -> tuple[int, int] | None:
    """Return width and height of the first training image of a NeRF-Synthetic scene; None if it cannot be read."""
    path = next(iter(sorted((scene.path / "train").glob("*.png"))), None)
    try:
        return None if path is None else image_size(path)
    except Gs2dError:
        return None


def _missing_figures(results: Results) -> list[str]:
    """Return failed and missing runs, and figures without any value."""
    lines: list[str] = []
    waiting, failed = 0, dict[tuple[str, str], list[str]]()
    for row in results.rows:
        for cell in row.cells:
            if cell.figures["bytes"] is None:
                if cell.reasons["bytes"] in NOT_YET:
                    waiting += 1
                else:
                    failed.setdefault((cell.scene, cell.reasons["bytes"]), []).append(f"{row.name} (seed {cell.seed})")
    lines += [f"{scene}: failed for {', '.join(runs)}: {why}" for (scene, why), runs in failed.items()]
    if waiting:
        lines.append(f"{waiting} runs are not finished yet")
    for data_set in results.data_sets:
        for metric in ("lpips", surface_metric(results.rows, data_set)):
            cells = [cell for row in results.rows for cell in row.of(data_set) if cell.figures["bytes"] is not None]
            lacking = [cell for cell in cells if cell.figures[metric] is None]
            reasons = sorted({cell.reasons.get(metric, "") for cell in lacking})
            if lacking:
                some = "" if len(lacking) == len(cells) else f" of {len(lacking)} runs"
                lines.append(f"{data_set}: no {METRICS[metric]}{some} ({'; '.join(reasons)})")
    return lines
