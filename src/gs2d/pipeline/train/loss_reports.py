"""What the losses of a recipe have to say of a finished stage: figures for ``metrics.json``, pictures beside."""

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

SHOWN = 3  # views whose pictures are kept


def report_losses(run: RunFolder, trainer: Trainer, views: Sequence[View]) -> dict[str, Any]:
    """Ask the losses that have a report about each training view; keep the pictures of a few in ``renders/losses``.

    Returns
    -------
    dict
        Empty where no loss has one; else ``losses``, by name of the loss: ``title`` and ``figure`` in words,
        ``median`` over views and ``by_view`` (both left out without figures), and ``shown``: views with their pictures.
    """
    reporters = trainer.loss_reporters
    if not reporters:
        return {}
    found: dict[str, dict[str, Any]] = {
        name: {
            "title": loss.title,
            "figure": loss.figure or name,
            "by_view": {},
            "shown": [],
        }
        for name, loss in reporters.items()
    }
    files = file_names(views)
    chosen = {(2 * i + 1) * len(views) // (2 * SHOWN) for i in range(SHOWN)}
    folder = run.file(RENDERS) / LOSSES
    make_folder(folder)
    for index, view in enumerate(views):
        for name, said in trainer.report_losses(index).items():
            if said.figure is not None:
                found[name]["by_view"][view.name] = float(said.figure)
            if index in chosen and said.images:
                stem = f"{files[index]}.{re.sub('[^A-Za-z0-9_-]+', '-', name)}"
                images = _draw(said.images)
                paths = {title: f"{stem}.{number}.png" for number, title in enumerate(images, start=1)}
                for title, image in images.items():
                    write_image(folder / paths[title], image)
                found[name]["shown"].append({"name": view.name, "images": paths})
    return {"losses": {name: _with_median(entry) for name, entry in found.items()}}


def _with_median(entry: dict[str, Any]) -> dict[str, Any]:
    figures = list(entry["by_view"].values())
    return entry | {"median": float(np.median(figures))} if figures else entry


def _draw(images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return colours [H, W, 3] for all; the first map of depths has the scale of the others."""
    maps = [(image, (image > 0).astype(np.float32)) for image in images.values() if image.ndim == 2]
    limits = depth_limits(*maps[0]) if maps else None
    return {
        title: depth_image(image, (image > 0).astype(np.float32), limits) if image.ndim == 2 else image
        for title, image in images.items()
    }
