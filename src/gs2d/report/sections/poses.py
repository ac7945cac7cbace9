"""The refined poses in the report: what a run's ``poses.json`` says, as a plot and in words."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.json_files import read_json
from gs2d.errors import DataError
from gs2d.report.html import drawing, escape, missing
from gs2d.report.plots import INK, plot_by_image, svg_text

MEASURES = ("pixels", "degrees", "shift")


def poses_section(path: Path, last_stage: Mapping[str, Any]) -> str:
    """Plot and sentences (HTML) about ``poses.json``.

    Parameters
    ----------
    path : Path
        The file; it may be missing.
    last_stage : mapping
        Entry of metrics.json.
    """
    if not path.exists():
        return missing(f"{path.name} is missing: it is written when training is finished.")
    names, far = _moved(path)
    most, mean = int(far[:, 0].argmax()), far.mean(axis=0)
    words = (
        f"Each training camera was moved to where the scene looks like its photograph: by {mean[0]:.2f} pixels in the "
        f"mean, most in {escape(names[most])} ({far[most, 0]:.2f} pixels). That is {mean[1]:.3f} degrees and "
        f"{100 * mean[2]:.3f} % of the scene's extent; a turn and a shift may cancel in the picture. Training views "
        "are scored and drawn, and the surface is fused, from there."
    )
    if last_stage.get("test"):
        words += " Test views keep the cameras of the capture, and nothing is fitted to test photographs."
    title = "How far each camera was moved, pixels at the distance of the scene's middle"
    plot = drawing(_plot(far[:, 0]), title)
    return f'<p>{words}</p>{_aligned(last_stage)}<div class="curves">{plot}</div>'


def _aligned(stage: Mapping[str, Any]) -> str:
    """The second score of the test views, where there is one."""
    plain, aligned = (stage.get(name) or {} for name in ("test", "test_aligned"))
    if not isinstance(aligned.get("psnr"), int | float) or not isinstance(plain.get("psnr"), int | float):
        return ""
    return (
        f"<p>Test views have {plain['psnr']:.2f} dB from where the capture says, and {aligned['psnr']:.2f} dB where "
        "each camera is moved to fit its photograph, which also forgives a scene that is not where it should be.</p>"
    )


def _moved(path: Path) -> tuple[list[str], np.ndarray]:
    """Names of the training views, and what each has moved by [V, 3]: pixels, degrees, share of the extent."""
    try:
        frames = [entry for entry in read_json(path)["frames"] if entry["split"] == "train"]
        names = [str(entry["name"]) for entry in frames]
        far = np.array([[entry["moved"][name] for name in MEASURES] for entry in frames], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path} must hold name and motion of each photograph, got another entry ({error})") from error
    if not names or not np.isfinite(far).all():
        raise DataError(f"{path} must hold finite numbers of one photograph or more, got others")
    return names, far


def _plot(pixels: np.ndarray) -> str:
    figure, axes = plot_by_image(2.4)
    axes.bar(np.arange(1, len(pixels) + 1), pixels, color="#3f86d6")
    axes.set_ylabel("px", fontsize=8, color=INK)
    return svg_text(figure)
