"""The losses on what is known beforehand of the training views, each with its data and its section in the report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gs2d.config.losses import register_loss
from gs2d.config.recipe import Recipe
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.losses.api import Loss, LossReport, LossView
from gs2d.losses.priors import Depths, PointDepths, Prior, RelativeDepths, aligned, depth_prior, normal_prior
from gs2d.render.types import RenderOutput
from gs2d.training.priors import Priors

HIT = 0.5  # least alpha of a pixel whose depth or normal is reported
POINT_RADIUS = 0.004  # of a point in the report, as a fraction of the picture's width


class _PriorLoss(Loss):
    """What both share: the priors of the views, read when they are asked for."""

    _priors: Priors

    def _of(self, output: RenderOutput, view: LossView) -> Prior:
        if view.index is None:
            raise RecipeError("losses on known depths and normals need the index of the training view, got none")
        return self._priors.of(view.index, view.run_iteration, output.color.dtype)


@register_loss("depth_prior")
class DepthPriorLoss(_PriorLoss):
    """Relative error of depths where they are known (docs/math.md, "Priors")."""

    settings = "depth_prior"
    title = "Known depths"
    figure = "relative error of depth, %"

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        """Find out what the capture knows; raise DataError where it knows nothing of what the recipe asks for."""
        self._priors = Priors(scene, replace(recipe, normal_prior=None), device=device)

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the loss []; None for a view of which nothing is known."""
        prior = self._of(output, view)
        if prior.depth is None:
            return None
        return depth_prior(prior, output.depth(view.depth_kind), output.alpha, view.mask)

    def report(self, output: RenderOutput, view: LossView) -> LossReport | None:
        """Return the median error of a view, and its known and rendered depth."""
        depths = self._of(output, view).depth
        if depths is None:
            return None
        known, error = relative_errors(depths, output.depth_mean, output.alpha > HIT)
        rendered = torch.where(output.alpha > HIT, output.depth_mean, 0).cpu().numpy()
        images = {"known depth": grown(known) if isinstance(depths, PointDepths) else known, "rendered depth": rendered}
        return LossReport(100 * float(error.median()) if len(error) else None, images)


@register_loss("normal_prior")
class NormalPriorLoss(_PriorLoss):
    """1 - cosine of normals where they are known (docs/math.md, "Priors")."""

    settings = "normal_prior"
    title = "Known normals"
    figure = "angle between normals, degrees"

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        """Find out what the capture knows; raise DataError where it knows nothing of what the recipe asks for."""
        self._priors = Priors(scene, replace(recipe, depth_prior=None), device=device)

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the loss []; None for a view of which nothing is known."""
        prior = self._of(output, view)
        return None if prior.normal is None else normal_prior(prior, output.normal, output.alpha, view.mask)

    def report(self, output: RenderOutput, view: LossView) -> LossReport | None:
        """Return the median angle of a view, and its known and rendered normals."""
        known = self._of(output, view).normal
        if known is None:
            return None
        rendered = torch.nn.functional.normalize(output.normal, dim=2)
        cosine = (rendered * known.directions).sum(dim=2).clamp(-1, 1)
        angles = torch.rad2deg(torch.acos(cosine))[(known.valid > 0) & (output.alpha > HIT)]
        images = {
            "known normals": as_colors(known.directions, known.valid),
            "rendered normals": as_colors(rendered, output.alpha),
        }
        return LossReport(float(angles.median()) if len(angles) else None, images)


def relative_errors(depths: Depths, rendered: Tensor, hit: Tensor) -> tuple[np.ndarray, Tensor]:
    """Known depths as an image [H, W] world units (0 = unknown), and a rendering's relative errors where it hit."""
    if isinstance(depths, PointDepths):
        places = depths.pixels.gather(1, depths.weights.argmax(dim=1)[:, None])[:, 0]
        image = torch.zeros_like(rendered).reshape(-1)
        image[places] = depths.depth
        seen = hit.reshape(-1)[depths.pixels].all(dim=1)
        at_points = rendered.reshape(-1)[depths.pixels[seen]]
        z = 1 / (depths.weights[seen] / at_points).sum(dim=1)
        return image.reshape(rendered.shape).cpu().numpy(), (z / depths.depth[seen] - 1).abs()
    known = aligned(depths, rendered, hit) if isinstance(depths, RelativeDepths) else depths
    image = torch.where(known.valid, 1 / torch.where(known.valid, known.disparity, 1), 0)
    return image.cpu().numpy(), (rendered * known.disparity - 1).abs()[known.valid & hit]


def grown(points: np.ndarray) -> np.ndarray:
    """Return a picture of single pixels as one of squares that can be seen."""
    radius = max(1, round(POINT_RADIUS * points.shape[1]))
    out = np.zeros_like(points)
    for row, column in zip(*np.nonzero(points), strict=True):
        out[max(0, row - radius) : row + radius + 1, max(0, column - radius) : column + radius + 1] = points[
            row, column
        ]
    return out


def as_colors(normals: Tensor, cover: Tensor) -> np.ndarray:
    """Return unit normals [H, W, 3] as colours (n + 1) / 2 over white, by how much [H, W] of a pixel they cover."""
    return ((0.5 * normals + 0.5) * cover[..., None] + (1 - cover[..., None])).clamp(0, 1).cpu().numpy()
