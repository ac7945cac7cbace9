"""The figures of a run as tables on a terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gs2d.cli.console import Console, figure
from gs2d.cli.verdict import say_verdict


def show_run(
    path: Path,
    metrics: dict[str, Any],
    console: Console,
    definition: dict[str, Any] | None = None,
    extra: dict[str, Any] | None = None,
) -> None:
    """Show the metrics of a run as a table, where its files are, and the verdict on it."""
    if definition is not None:
        recipe, scene = definition["recipe"]["name"], definition["scene"]
        console.say(f"{recipe} on {scene['name']} ({scene['format']}, {scene['train']} + {scene['test']} views)")
    rows = []
    for stage in metrics["stages"]:
        seen = stage.get("test") or stage.get("train") or {}
        rows.append(
            [
                stage["name"],
                f"{stage['iterations']:,}",
                figure(stage["seconds"], 0),
                f"{stage['splats']:,}",
                figure(stage["bytes"] / 1e6, 1),
                figure((stage.get("train") or {}).get("psnr"), 2),
                figure((stage.get("test") or {}).get("psnr"), 2),
                figure(seen.get("ssim"), 4),
            ]
        )
    columns = ["stage", "iter.", "seconds", "splats", "MB", "PSNR train", "test", "SSIM"]
    console.table("", columns, rows)
    show_surface(metrics.get("surface"), console)
    for name in ("report.html", "scene.html", "mesh.ply", "mesh.glb", "splats.ply"):
        if (path / name).exists():
            console.say(f"{path / name}")
    extra = (extra or {}) | ({} if definition is None else {"definition": definition}) | say_verdict(path, console)
    console.result({"run": str(path), **metrics, **extra})


def score_rows(split: str, metrics: dict[str, Any] | None) -> list[list[str]]:
    """Return two rows: from 8-bit pictures, as the official evaluation takes them, and from floats."""
    scores = metrics or {}
    rounded = [figure(scores.get("psnr"), 2), figure(scores.get("ssim"), 4)]
    floats = [figure(scores.get("psnr_float"), 2), figure(scores.get("ssim_float"), 4)]
    lpips = [figure(scores.get(name), 4) for name in ("lpips", "lpips_signed")]
    return [[split, "8 bit", *rounded, *lpips], ["", "floats", *floats, "", ""]]


def show_surface(surface: dict[str, Any] | None, console: Console) -> None:
    """Show how near a mesh is to the true surface, where that was measured."""
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
