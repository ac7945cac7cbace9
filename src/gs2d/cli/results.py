"""The results of commands as tables and lines on a terminal."""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gs2d.cli.console import Console, figure
from gs2d.errors import DataError, RunError

WIDTH = 60  # columns of the verdict: half of a small screen
_NAMES, _GRADES = 14, 8  # columns of the names and grades of findings
_FILES = ("report.html", "scene.html", "mesh.ply", "mesh.glb", "splats.ply")


def show_run(
    path: Path,
    metrics: dict[str, Any],
    console: Console,
    definition: dict[str, Any] | None = None,
    extra: dict[str, Any] | None = None,
) -> None:
    """Show the metrics of a run as a table, its files, and its verdict; all of it with ``extra`` as JSON."""
    from gs2d.report.sections.verdict_section import read_verdict

    result = {"run": str(path), **metrics, **(extra or {})}
    if definition is not None:
        recipe, scene = definition["recipe"]["name"], definition["scene"]
        console.say(f"{recipe} on {scene['name']} ({scene['format']}, {scene['train']} + {scene['test']} views)")
        result["definition"] = definition
    columns = ["stage", "iter.", "seconds", "splats", "MB", "PSNR train", "test", "SSIM"]
    console.table("", columns, [_stage_row(stage) for stage in metrics["stages"]])
    show_surface(metrics.get("surface"), console)
    for name in _FILES:
        if (path / name).exists():
            console.say(f"{path / name}")
    try:
        verdict = read_verdict(path)
    except (DataError, RunError):  # the report names the error
        verdict = None
    result["verdict"] = verdict
    for line in verdict_lines(verdict) if verdict is not None else ():
        console.say(line)
    console.result(result)


def _stage_row(stage: dict[str, Any]) -> list[str]:
    train, test = stage.get("train") or {}, stage.get("test") or {}
    return [
        stage["name"],
        f"{stage['iterations']:,}",
        figure(stage["seconds"], 0),
        f"{stage['splats']:,}",
        figure(stage["bytes"] / 1e6, 1),
        figure(train.get("psnr"), 2),
        figure(test.get("psnr"), 2),
        figure((test or train).get("ssim"), 4),
    ]


def verdict_lines(verdict: Mapping[str, Any], width: int = WIDTH) -> list[str]:
    """Return a verdict (that of ``verdict.json``) in lines of at most ``width`` columns."""
    grade = verdict["grade"]
    lines = textwrap.wrap(f"Verdict: {str(grade or 'none').upper()}. {verdict['headline']}", width)
    for finding in verdict["findings"]:
        start = f"  {finding['grade'] or '-':<{_GRADES - 1}} {finding['name']:<{_NAMES - 1}} "
        lines += textwrap.wrap(finding["figure"], width, initial_indent=start, subsequent_indent=" " * len(start))
    advice = [finding["advice"] for finding in verdict["findings"] if finding["advice"]]
    if advice:
        lines.append("What to do next:")
    for text in advice:
        lines += textwrap.wrap(text, width, initial_indent="- ", subsequent_indent="  ")
    return lines


def score_rows(split: str, metrics: dict[str, Any] | None) -> list[list[str]]:
    """Return two rows of scores: of 8-bit images, as in the official evaluation, and of float images."""
    scores = metrics or {}
    rounded = [figure(scores.get("psnr"), 2), figure(scores.get("ssim"), 4)]
    floats = [figure(scores.get("psnr_float"), 2), figure(scores.get("ssim_float"), 4)]
    lpips = [figure(scores.get(name), 4) for name in ("lpips", "lpips_signed")]
    return [[split, "8 bit", *rounded, *lpips], ["", "floats", *floats, "", ""]]


def show_surface(surface: dict[str, Any] | None, console: Console) -> None:
    """Show the distance of a mesh from the true surface, if it was measured."""
    if not surface:
        return
    rows = [
        [f"{row['threshold']:.4g}", *(figure(row[name], 4) for name in ("precision", "recall", "f_score"))]
        for row in surface.get("thresholds") or []
    ]
    if rows:
        console.table("", ["surface within", "precision", "recall", "F-score"], rows)
    if surface.get("chamfer") is not None:
        console.say(f"Chamfer distance {surface['chamfer']:.5g} {surface.get('unit', 'world units')}")


def poses_lines(result: dict[str, Any]) -> list[str]:
    """Return the result of ``gs2d poses``: photographs with and without a camera, and the next command."""
    from gs2d.pipeline.prepare.pose_finding import lost_lines, placed_line

    lines = [
        placed_line(result),
        *(f"camera: {camera['about']}" for camera in result["cameras"][:4]),
    ]
    if len(result["cameras"]) > 4:
        lines.append(f"and {len(result['cameras']) - 4} more cameras, in poses.json")
    lines += lost_lines(result)
    for other in result["other_models"]:
        lines.append(
            f"{other['folder']} holds a separate piece: {len(other['photos'])} photographs, {other['points']:,} points"
        )
    capture = result["capture"]
    lines.append(f"look at {capture}/poses.png, then: gs2d train {shlex.quote(capture)} --out RUN")
    return lines
