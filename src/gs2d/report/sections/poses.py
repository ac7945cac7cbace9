"""Refined cameras, from ``poses.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.camera import Zoom
from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.io.run_dir import POSES
from gs2d.report.html import missing, render
from gs2d.report.plots import INK, plot_by_image, svg_text
from gs2d.report.record import RunRecord
from gs2d.report.sections.registry import register_section

MEASURES = ("pixels", "degrees", "shift")


@register_section("poses", title="Refined cameras")
def poses_section(run: RunRecord) -> str | None:
    """Return how far the cameras moved, with a plot; None where the recipe refines none."""
    if not run.recipe.get("poses"):
        return None
    path = run.path / POSES
    if not path.exists():
        return missing(f"{path.name} is missing: it is written when training is finished.")
    names, far, zooms = _moved(path)
    most, mean = int(far[:, 0].argmax()), far.mean(axis=0)
    return render(
        "poses.html",
        pixels=mean[0],
        degrees=mean[1],
        percent=100 * mean[2],
        most={"name": names[most], "pixels": far[most, 0]},
        has_test=bool(run.last.get("test")),
        aligned=_aligned(run.last),
        plot=_plot(far[:, 0]),
        zooms=[] if zooms is None else [f"{scale:.4f}" for scale in sorted({zooms[:, 0].min(), zooms[:, 0].max()})],
        lenses=[] if zooms is None else [f"k1 {k1:+.4f}, k2 {k2:+.4f}" for k1, k2 in _bent(zooms)],
    )


def _aligned(stage: Mapping[str, Any]) -> dict[str, float] | None:
    """Return the second score of the test views, where there is one."""
    plain, aligned = (stage.get(name) or {} for name in ("test", "test_aligned"))
    if not isinstance(aligned.get("psnr"), int | float) or not isinstance(plain.get("psnr"), int | float):
        return None
    return {"plain": plain["psnr"], "aligned": aligned["psnr"]}


def _moved(path: Path) -> tuple[list[str], np.ndarray, np.ndarray | None]:
    """Names of the training views, and what each has moved by [V, 3]: pixels, degrees, share of the extent.

    And what became of their focal lengths, as factors, and their lenses [V, 3] where those were refined.
    """
    try:
        frames = [entry for entry in read_json(path)["frames"] if entry["split"] == "train"]
        names = [str(entry["name"]) for entry in frames]
        far = np.array([[entry["moved"][name] for name in MEASURES] for entry in frames], dtype=np.float64)
        refined = bool(frames) and "zoom" in frames[0]
        zooms = np.array([_zoom(entry["zoom"]) for entry in frames]) if refined else None
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path} must hold name and motion of each photograph, got another entry ({error})") from error
    if not names or not np.isfinite(far).all():
        raise DataError(f"{path} must hold finite numbers of one photograph or more, got others")
    return names, far, zooms


def _zoom(numbers: Sequence[float]) -> list[float]:
    """Return factor, k1 and k2; runs that learned no lens have three numbers."""
    zoom = Zoom(*map(float, numbers))
    return [zoom.scale, zoom.k1, zoom.k2]


def _bent(zooms: np.ndarray) -> list[tuple[float, float]]:
    """Return k1 and k2 of each camera of which something of the lens is left."""
    return sorted({(float(k1), float(k2)) for _, k1, k2 in zooms if k1 or k2})


def _plot(pixels: np.ndarray) -> str:
    figure, axes = plot_by_image(2.4)
    axes.bar(np.arange(1, len(pixels) + 1), pixels, color="#3f86d6")
    axes.set_ylabel("px", fontsize=8, color=INK)
    return svg_text(figure)
