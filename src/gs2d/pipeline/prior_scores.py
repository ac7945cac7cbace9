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
from gs2d.losses.priors import Depths, KnownNormals, PointDepths, RelativeDepths, aligned
from gs2d.pipeline.job import Job
from gs2d.pipeline.render import file_names
from gs2d.render.api import rasterize
from gs2d.render.types import RenderOutput
from gs2d.report.images import depth_limits, depth_picture, normal_picture
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
        depth, normal = priors.known(index, splats.dtype)
        if depth is None and normal is None:
            continue
        with torch.no_grad():
            output = rasterize(splats, view.camera, job.settings, backend=job.backend)
        pictures: dict[str, np.ndarray] = {}
        if depth is not None:
            error, drawn = _of_depth(depth, output)
            by_view["depth_prior"] |= {} if error is None else {view.name: error}
            pictures |= drawn
        if normal is not None:
            error, drawn = _of_normal(normal, output)
            by_view["normal_prior"] |= {} if error is None else {view.name: error}
            pictures |= drawn
        if index in chosen:
            for what, image in pictures.items():
                write_image(folder / f"{files[index]}.{what}.png", image)
            shown.append({"name": view.name, "file": files[index], "images": list(pictures)})
    found: dict[str, Any] = {
        name: {"median": float(np.median(list(errors.values()))), "by_view": errors}
        for name, errors in by_view.items()
        if errors
    }
    return {**found, "priors_shown": shown}


def _of_depth(depth: Depths, output: RenderOutput) -> tuple[float | None, dict[str, np.ndarray]]:
    """The median error of a view, and pictures of known and rendered depth."""
    known, error = against(depth, output.depth_mean, output.alpha > 0.5)
    limits = depth_limits(known, (known > 0).astype(np.float32))
    there = grown(known) if isinstance(depth, PointDepths) else known
    pictures = {
        "known-depth": depth_picture(there, (there > 0).astype(np.float32), limits),
        "depth": depth_picture(output.depth_mean.cpu().numpy(), output.alpha.cpu().numpy(), limits),
    }
    return (float(error.median()) if len(error) else None), pictures


def _of_normal(normal: KnownNormals, output: RenderOutput) -> tuple[float | None, dict[str, np.ndarray]]:
    """The median angle of a view, degrees, and pictures of known and rendered normals."""
    cosine = (torch.nn.functional.normalize(output.normal, dim=2) * normal.directions).sum(dim=2).clamp(-1, 1)
    angles = torch.rad2deg(torch.acos(cosine))[(normal.known > 0) & (output.alpha > 0.5)]
    pictures = {
        "known-normal": normal_picture(normal.directions.cpu().numpy(), normal.known.cpu().numpy()),
        "normal": normal_picture(output.normal.cpu().numpy(), output.alpha.cpu().numpy()),
    }
    return (float(angles.median()) if len(angles) else None), pictures


def against(depths: Depths, rendered: Tensor, hit: Tensor) -> tuple[np.ndarray, Tensor]:
    """Known depths as a picture [H, W] wu (0 = unknown), and the relative errors of a rendering where it hit them."""
    if isinstance(depths, PointDepths):
        places = depths.pixels.gather(1, depths.weights.argmax(dim=1)[:, None])[:, 0]
        picture = torch.zeros_like(rendered).reshape(-1)
        picture[places] = depths.depth
        seen = hit.reshape(-1)[depths.pixels].all(dim=1)
        at_points = rendered.reshape(-1)[depths.pixels[seen]]
        z = 1 / (depths.weights[seen] / at_points).sum(dim=1)
        return picture.reshape(rendered.shape).cpu().numpy(), (z / depths.depth[seen] - 1).abs()
    known = aligned(depths, rendered, hit) if isinstance(depths, RelativeDepths) else depths
    picture = torch.where(known.known, 1 / torch.where(known.known, known.disparity, 1), 0)
    return picture.cpu().numpy(), (rendered * known.disparity - 1).abs()[known.known & hit]


def grown(points: np.ndarray) -> np.ndarray:
    """A picture of single pixels as one of squares that can be seen."""
    radius = max(1, round(POINT_RADIUS * points.shape[1]))
    out = np.zeros_like(points)
    for row, column in zip(*np.nonzero(points), strict=True):
        out[max(0, row - radius) : row + radius + 1, max(0, column - radius) : column + radius + 1] = points[
            row, column
        ]
    return out
