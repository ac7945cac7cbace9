"""Images of a run for the report: a few views after every stage."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.json_files import write_json
from gs2d.core.sh import rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.core.text import name_bytes
from gs2d.data import View
from gs2d.data.image_files import write_image
from gs2d.io.run_dir import RENDERS, RunFolder, make_folder
from gs2d.pipeline.finish.trusted_depth import believed_reach, within_reach
from gs2d.pipeline.prepare.learned_views import photographed
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.report.color_maps import depth_image, depth_limits, error_image, highlight_image, normal_image, valid_image
from gs2d.report.gallery import Gallery, read_gallery

INDEX = "index.json"
LONGEST_NAME = 180  # bytes; file systems allow 255, including the kind of image and a temporary suffix
IMAGES = ("color", "normal", "depth", "error", "high_error")
SHOWN_VIEWS = 3  # rendered after each stage for the report


def file_names(views: Sequence[View]) -> list[str]:
    """Return a file name without suffix for each view; names that are too long or equal get a hash."""
    names = []
    for view in views:
        name = Path(view.name.replace("/", "__")).stem
        whole = name_bytes(name)
        short = whole[:LONGEST_NAME].decode(errors="ignore")
        names.append(name if len(whole) <= LONGEST_NAME else f"{short}-{_short_hash(name)}")
    count = Counter(name.casefold() for name in names)  # some file systems ignore case
    return [
        name if count[name.casefold()] == 1 else f"{name}-{_short_hash(view.name)}"
        for name, view in zip(names, views, strict=True)
    ]


def _short_hash(text: str) -> str:
    return hashlib.sha256(name_bytes(text)).hexdigest()[:8]


def draw_stage(run: RunFolder, trained: Trained, stage: str, group: Tensor | None) -> None:
    """Write the images of one stage, the photographs, and the index of both, of a few test views (or training views).

    They are drawn with the appearance of their photographs, as far as the scene knows it. ``group`` [N] bool are the
    high-error splats, once they are available.
    """
    scene, background = trained.scene, trained.settings.background
    split, every = ("test", scene.test) if scene.test else ("train", scene.train)
    count = min(SHOWN_VIEWS, len(every))
    shown = [every[(2 * i + 1) * len(every) // (2 * count)] for i in range(count)]  # evenly spaced
    folder = run.file(RENDERS)
    for name in ("photos", stage):
        make_folder(folder / name)
    drawn = read_gallery(folder) or Gallery(folder, (), ())
    limits = {view.name: view.depth_limits for view in drawn.views}
    views = []
    for view, file in zip(shown, file_names(shown), strict=True):
        output = trained.render(view.camera)
        depth = output.depth(trained.protocol.depth).cpu().numpy()
        alpha = output.alpha.cpu().numpy()
        # All stages use the limits of the first, so that they can be compared.
        near_far = limits.get(view.name)
        if near_far is None:  # from depths within reach, if there are any
            reach = believed_reach(scene)
            near = alpha if reach is None else alpha * within_reach(reach, view.camera, depth)
            near_far = depth_limits(depth, near if (near >= 0.5).any() else alpha)
        photo = view.target(background)
        color = photographed(view, output.color, background).cpu().numpy()
        images = {
            "color": np.clip(color, 0, 1),
            "normal": normal_image(output.normal.cpu().numpy(), alpha),
            "depth": depth_image(depth, alpha, near_far),
            "error": error_image(color, photo, view.mask()),
        }
        if group is not None:
            fraction = splatted(trained, group, view.camera)
            images["high_error"] = highlight_image(color, fraction)
        for what, image in images.items():
            write_image(folder / stage / f"{file}.{what}.png", image)
        write_image(folder / "photos" / f"{file}.png", valid_image(photo, view.valid()))
        shown_as = {"name": view.name, "file": file, "split": split, "depth_limits": near_far}
        views.append({**shown_as, "camera": camera_json(view.camera)})
    stages = [*(name for name in drawn.stages if name != stage), stage]
    write_json(folder / INDEX, {"views": views, "stages": stages, "images": list(IMAGES)})


def camera_json(camera: Camera) -> dict[str, Any]:
    """Return a camera as JSON values, the keyword arguments of ``Camera``."""
    intrinsics = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return {**intrinsics, "T_cam_world": camera.T_cam_world.tolist()}


def splatted(trained: Trained, values: Tensor, camera: Camera) -> np.ndarray:
    """Return the sum over splats of blending weight times ``values`` [N] (>= 0) in each pixel, [H, W].

    With a boolean row group as ``values`` this is the fraction of each pixel that the group covers.
    """
    splats = trained.splats
    grey = values.to(splats.dtype)[:, None].expand(-1, 3)
    marked = Splats(**{**dict(splats.items()), "sh0": rgb_to_sh0(grey), "shN": torch.zeros_like(splats.shN)})
    drawing = replace(trained, splats=marked, settings=replace(trained.settings, background=(0.0, 0.0, 0.0)))
    return np.asarray(drawing.render(camera).color[..., 0].cpu().numpy())
