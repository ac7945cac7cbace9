"""Reports of the losses on a finished stage: values for ``metrics.json`` and images."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gs2d.data import View
from gs2d.data.image_files import write_image
from gs2d.io.run_dir import LOSSES, RENDERS, RunFolder, make_folder
from gs2d.pipeline.finish.run_images import file_names
from gs2d.report.color_maps import depth_image, depth_limits
from gs2d.training.trainer import Trainer

SHOWN = 3  # views whose images are kept


def report_losses(run: RunFolder, trainer: Trainer, views: Sequence[View]) -> dict[str, Any]:
    """Collect the reports of losses on each training view; write the images of a few views to ``renders/losses``.

    Returns
    -------
    dict
        Empty if no loss has a report; else ``losses``, by name: ``title`` and ``figure`` as text, ``median`` over views
        and ``by_view`` (absent without values), and ``shown``, the views with their images.
    """
    reporters = trainer.loss_reporters
    if not reporters:
        return {}
    found: dict[str, dict[str, Any]] = {
        name: {"title": loss.title, "figure": loss.figure or name, "by_view": {}, "shown": []}
        for name, loss in reporters.items()
    }
    files = file_names(views)
    chosen = {(2 * i + 1) * len(views) // (2 * SHOWN) for i in range(SHOWN)}
    folder = run.file(RENDERS) / LOSSES
    make_folder(folder)
    for index, view in enumerate(views):
        for name, report in trainer.report_losses(index).items():
            if report.figure is not None:
                found[name]["by_view"][view.name] = float(report.figure)
            if index in chosen and report.images:
                stem = f"{files[index]}.{re.sub('[^A-Za-z0-9_-]+', '-', name)}"
                images = _draw(report.images)
                paths = {title: f"{stem}.{number}.png" for number, title in enumerate(images, start=1)}
                for title, image in images.items():
                    write_image(folder / paths[title], image)
                found[name]["shown"].append({"name": view.name, "images": paths})
    return {"losses": {name: _with_median(entry) for name, entry in found.items()}}


def _with_median(entry: dict[str, Any]) -> dict[str, Any]:
    figures = list(entry["by_view"].values())
    return entry | {"median": float(np.median(figures))} if figures else entry


def _draw(images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return colour images [H, W, 3]; all depth maps have the colour scale of the first."""
    maps = [(image, (image > 0).astype(np.float32)) for image in images.values() if image.ndim == 2]
    limits = depth_limits(*maps[0]) if maps else None
    return {
        title: depth_image(image, (image > 0).astype(np.float32), limits) if image.ndim == 2 else image
        for title, image in images.items()
    }
