"""Pictures of a run: a few views after every stage, or any views as PNG files."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.images import write_image
from gs2d.core.json_files import write_json
from gs2d.core.sh import rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.data import Scene, View
from gs2d.errors import DataError
from gs2d.io.run_dir import RENDERS, RunFolder, make_folder
from gs2d.pipeline.evaluate import evenly
from gs2d.pipeline.exposure import NONE, Transforms, photographed
from gs2d.pipeline.job import Job
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.report.images import (
    depth_image,
    depth_limits,
    error_image,
    highlight_image,
    normal_image,
    valid_image,
)
from gs2d.report.sections.pictures import read_index

INDEX = "index.json"
LONGEST_NAME = 180  # bytes; file systems take 255, and a picture's kind and a temporary suffix come after it
IMAGES = ("color", "normal", "depth", "error", "high_error")


def choose_views(scene: Scene, count: int) -> list[tuple[str, View]]:
    """(split, view) of the views to show: test views where there are any, spread evenly."""
    split, views = ("test", scene.test) if scene.test else ("train", scene.train)
    return [(split, view) for view in evenly(views, count)]


def file_name(view: View) -> str:
    """A view's name as the start of a file name; a long one is cut, and a hash of the whole tells it from others."""
    name = Path(view.name.replace("/", "__")).stem
    whole = name.encode()
    if len(whole) <= LONGEST_NAME:
        return name
    return whole[:LONGEST_NAME].decode(errors="ignore") + "-" + _short_hash(name)


def file_names(views: Sequence[View]) -> list[str]:
    """``file_name`` of each view; those that would share a file (x.png and x.jpg, a/b and a__b) differ by a hash."""
    names = [file_name(view) for view in views]
    count = Counter(name.casefold() for name in names)  # not every file system knows upper from lower case
    return [
        name if count[name.casefold()] == 1 else f"{name}-{_short_hash(view.name)}"
        for name, view in zip(names, views, strict=True)
    ]


def _short_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def draw_stage(
    run: RunFolder,
    job: Job,
    shown: Sequence[tuple[str, View]],
    stage: str,
    splats: Splats,
    group: Tensor | None,
    exposures: Transforms = NONE,
    outputs: Mapping[str, RenderOutput] = MappingProxyType({}),
) -> None:
    """Write the pictures of one stage, the photographs, and the index of both.

    Training views are drawn in the exposures of their photographs, where those are known.

    Parameters
    ----------
    group : Tensor [N] bool or None
        The high-error splats, once they are known.
    outputs : mapping
        By the name of the view: what was rendered of these splats already.

    Raises
    ------
    DiskError
    """
    folder = run.file(RENDERS)
    for name in ("photos", stage):
        make_folder(folder / name)
    index_file = folder / INDEX
    index = read_index(folder) or {"views": [], "stages": []}
    limits = {entry["name"]: entry.get("depth_limits") for entry in index["views"]}
    views = []
    files = file_names([view for _, view in shown])
    for (split, view), file in zip(shown, files, strict=True):
        output = outputs.get(view.name) or render_view(splats, view, job.settings, job.backend)
        depth = output.depth(job.protocol.depth).cpu().numpy()
        alpha = output.alpha.cpu().numpy()
        near_far = limits.get(view.name) or list(depth_limits(depth, alpha))  # of the first stage: stages compare
        photo = view.target(job.settings.background)
        color = photographed(view, output.color, exposures, job.settings.background).cpu().numpy()
        images = {
            "color": np.clip(color, 0, 1),
            "normal": normal_image(output.normal.cpu().numpy(), alpha),
            "depth": depth_image(depth, alpha, (near_far[0], near_far[1])),
            "error": error_image(color, photo, view.mask()),
        }
        if group is not None:
            fraction = fraction_of_group(splats, group, view, job.settings, job.backend)
            images["high_error"] = highlight_image(color, fraction)
        for what, image in images.items():
            write_image(folder / stage / f"{file}.{what}.png", image)
        write_image(folder / "photos" / f"{file}.png", valid_image(photo, view.valid()))
        shown_as = {"name": view.name, "file": file, "split": split, "depth_limits": near_far}
        views.append({**shown_as, "camera": camera_json(view.camera)})
    stages = [*(name for name in index["stages"] if name != stage), stage]
    write_json(index_file, {"views": views, "stages": stages, "images": list(IMAGES)})


def camera_json(camera: Camera) -> dict[str, Any]:
    """A camera as plain numbers; ``Camera(**it)`` is the camera again."""
    facts = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return {**facts, "T_cam_world": camera.T_cam_world.tolist()}


def shown_cameras(run: RunFolder) -> list[Camera]:
    """Cameras of the views that were drawn; none before the first stage was.

    Raises
    ------
    DataError
        The index of the pictures is broken.
    """
    index = read_index(run.file(RENDERS)) or {"views": []}
    try:
        return [Camera(**entry["camera"]) for entry in index["views"]]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{run.file(RENDERS) / INDEX} must hold the camera of each view, got another entry ({error}); delete it "
            "(the report then has no pictures of views), or train again with --overwrite"
        ) from error


def render_view(splats: Splats, view: View, settings: RasterSettings, backend: Backend) -> RenderOutput:
    """All images of one view, without gradients."""
    with torch.no_grad():
        return rasterize(splats, view.camera, settings, backend=backend)


def fraction_of_group(
    splats: Splats, group: Tensor, view: View, settings: RasterSettings, backend: Backend
) -> np.ndarray:
    """How much of each pixel the splats of a row group make up: their blending weights, summed; [H, W] in [0, 1]."""
    return splatted(splats, group, view, settings, backend)


def splatted(splats: Splats, values: Tensor, view: View, settings: RasterSettings, backend: Backend) -> np.ndarray:
    """The sum over splats of blending weight times ``values`` [N] (>= 0) in each pixel, [H, W].

    Drawn as a scene in which each splat is as grey as its value says, over black.
    """
    grey = values.to(splats.dtype)[:, None].expand(-1, 3)
    marked = Splats(**{**dict(splats.items()), "sh0": rgb_to_sh0(grey), "shN": torch.zeros_like(splats.shN)})
    settings = replace(settings, background=(0.0, 0.0, 0.0))
    return np.asarray(render_view(marked, view, settings, backend).color[..., 0].cpu().numpy())
