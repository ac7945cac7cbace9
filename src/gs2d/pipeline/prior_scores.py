"""How far a scene of splats is from what was known of its views: figures for ``metrics.json``, pictures beside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.core.images import write_image
from gs2d.core.splats import Splats
from gs2d.data import View
from gs2d.io.run_dir import PRIORS, RENDERS, RunFolder, make_folder
from gs2d.losses.priors import Depths, NormalTarget, PointDepths, RelativeDepths, aligned
from gs2d.pipeline.job import Job
from gs2d.pipeline.render import file_names
from gs2d.render.api import rasterize
from gs2d.render.types import RenderOutput
from gs2d.report.images import depth_image, depth_limits, normal_image
from gs2d.training.priors import Priors, has_priors

SHOWN = 3  # views whose known depths are drawn
POINT_RADIUS = 0.004  # of a drawn point, as a share of the picture's width


def score_priors(run: RunFolder, job: Job, views: Sequence[View], splats: Splats) -> dict[str, Any]:
    """How far rendered depths and normals are from the known ones, by training view; a few are drawn.

    Empty where the recipe asks for nothing.

    Returns
    -------
    dict
        ``depth_prior``: ``median`` over views, and ``by_view`` the median over known pixels or points of |z / d - 1|;
        ``normal_prior``: the same of angles in degrees; ``priors_shown``: pictures in ``renders/priors``.
    """
    if not has_priors(job.recipe):
        return {}
    priors = Priors(job.scene, job.recipe, device=job.backend.device, limit_bytes=0)
    by_view: dict[str, dict[str, float]] = {"depth_prior": {}, "normal_prior": {}}
    files = file_names(views)
    chosen = {(2 * i + 1) * len(views) // (2 * SHOWN) for i in range(SHOWN)}
    shown = []
    folder = run.file(RENDERS) / PRIORS
    make_folder(folder)
    for index, view in enumerate(views):
        depth, normal = priors.at(index, splats.dtype)
        if depth is None and normal is None:
            continue
        with torch.no_grad():
            output = rasterize(splats, view.camera, job.settings, backend=job.backend)
        images: dict[str, np.ndarray] = {}
        if depth is not None:
            error, drawn = _of_depth(depth, output)
            by_view["depth_prior"] |= {} if error is None else {view.name: error}
            images |= drawn
        if normal is not None:
            error, drawn = _of_normal(normal, output)
            by_view["normal_prior"] |= {} if error is None else {view.name: error}
            images |= drawn
        if index in chosen:
            for what, image in images.items():
                write_image(folder / f"{files[index]}.{what}.png", image)
            shown.append({"name": view.name, "file": files[index], "images": list(images)})
    found: dict[str, Any] = {
        name: {"median": float(np.median(list(errors.values()))), "by_view": errors}
        for name, errors in by_view.items()
        if errors
    }
    return {**found, "priors_shown": shown}


def _of_depth(depth: Depths, output: RenderOutput) -> tuple[float | None, dict[str, np.ndarray]]:
    """Return the median error of a view, and pictures of known and rendered depth."""
    valid, error = against(depth, output.depth_mean, output.alpha > 0.5)
    limits = depth_limits(valid, (valid > 0).astype(np.float32))
    there = grown(valid) if isinstance(depth, PointDepths) else valid
    images = {
        "known-depth": depth_image(there, (there > 0).astype(np.float32), limits),
        "depth": depth_image(output.depth_mean.cpu().numpy(), output.alpha.cpu().numpy(), limits),
    }
    return (float(error.median()) if len(error) else None), images


def _of_normal(normal: NormalTarget, output: RenderOutput) -> tuple[float | None, dict[str, np.ndarray]]:
    """Return the median angle of a view, degrees, and pictures of known and rendered normals."""
    cosine = (torch.nn.functional.normalize(output.normal, dim=2) * normal.directions).sum(dim=2).clamp(-1, 1)
    angles = torch.rad2deg(torch.acos(cosine))[(normal.valid > 0) & (output.alpha > 0.5)]
    images = {
        "known-normal": normal_image(normal.directions.cpu().numpy(), normal.valid.cpu().numpy()),
        "normal": normal_image(output.normal.cpu().numpy(), output.alpha.cpu().numpy()),
    }
    return (float(angles.median()) if len(angles) else None), images


def against(depths: Depths, rendered: Tensor, hit: Tensor) -> tuple[np.ndarray, Tensor]:
    """Known depths as an image [H, W] world units (0 = unknown), and a rendering's relative errors where it hit."""
    if isinstance(depths, PointDepths):
        places = depths.pixels.gather(1, depths.weights.argmax(dim=1)[:, None])[:, 0]
        image = torch.zeros_like(rendered).reshape(-1)
        image[places] = depths.depth
        seen = hit.reshape(-1)[depths.pixels].all(dim=1)
        at_points = rendered.reshape(-1)[depths.pixels[seen]]
        z = 1 / (depths.weights[seen] / at_points).sum(dim=1)
        return image.reshape(rendered.shape).cpu().numpy(), (z / depths.depth[seen] - 1).abs()
    valid = aligned(depths, rendered, hit) if isinstance(depths, RelativeDepths) else depths
    image = torch.where(valid.valid, 1 / torch.where(valid.valid, valid.disparity, 1), 0)
    return image.cpu().numpy(), (rendered * valid.disparity - 1).abs()[valid.valid & hit]


def grown(points: np.ndarray) -> np.ndarray:
    """Return a picture of single pixels as one of squares that can be seen."""
    radius = max(1, round(POINT_RADIUS * points.shape[1]))
    out = np.zeros_like(points)
    for row, column in zip(*np.nonzero(points), strict=True):
        out[max(0, row - radius) : row + radius + 1, max(0, column - radius) : column + radius + 1] = points[
            row, column
        ]
    return out
