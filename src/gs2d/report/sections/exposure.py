"""Learned exposures of the photographs, from ``exposure.json``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.io.run_dir import EXPOSURE
from gs2d.report.html import missing, render
from gs2d.report.plots import INK, plot_by_image, svg_text
from gs2d.report.record import RunRecord
from gs2d.report.sections.registry import register_section

GREY = 0.5  # colour of the scene whose image is plotted
_CHANNELS = {"red": "#d0463b", "green": "#3f9a5f", "blue": "#3f86d6"}


@register_section("exposure", title="Exposure of the photographs")
def exposure_section(run: RunRecord) -> str | None:
    """Return the darkest and brightest photograph and a plot; None where the recipe learns no exposure."""
    if not run.recipe.get("exposure"):
        return None
    path = run.path / EXPOSURE
    if not path.exists():
        return missing(f"{path.name} is missing: it is written when training is finished.")
    names, gains = _gains(path)
    low, high = int(gains.mean(axis=1).argmin()), int(gains.mean(axis=1).argmax())
    dark, bright = ({"name": names[row], "gain": gains[row].mean()} for row in (low, high))
    return render("exposure.html", dark=dark, bright=bright, matched=_matched(run.last), plot=_plot(gains))


def _matched(stage: Mapping[str, Any]) -> dict[str, float] | None:
    """Return the second score of the test views, where there is one."""
    plain, matched = (stage.get(name) or {} for name in ("test", "test_matched"))
    if not isinstance(matched.get("psnr"), int | float) or not isinstance(plain.get("psnr"), int | float):
        return None
    return {"plain": plain["psnr"], "matched": matched["psnr"]}


def _gains(path: Path) -> tuple[list[str], np.ndarray]:
    """Names, and what a middle grey becomes as a share of itself [V, 3]."""
    try:
        images = read_json(path)["photographs"]
        names = [str(entry["name"]) for entry in images]
        gains = np.array([entry["grey"] for entry in images], dtype=np.float64).reshape(len(names), 3) / GREY
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path} must hold name and grey of each photograph, got another entry ({error})") from error
    if not names or not np.isfinite(gains).all():
        raise DataError(f"{path} must hold finite numbers of one photograph or more, got others")
    return names, gains


def _plot(gains: np.ndarray) -> str:
    figure, axes = plot_by_image(2.7)
    axes.axhline(1.0, color=INK, linewidth=0.8)
    for k, (name, color) in enumerate(_CHANNELS.items()):
        axes.plot(
            np.arange(1, len(gains) + 1), gains[:, k], "o-", color=color, markersize=2.5, linewidth=0.8, label=name
        )
    axes.legend(fontsize=8, frameon=False, labelcolor=INK, ncols=3)
    return svg_text(figure)
