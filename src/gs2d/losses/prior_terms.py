"""The losses on known depths and normals of training views, with their data and their report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gs2d.config.loss_registry import register_loss
from gs2d.config.prior_settings import DepthPrior, NormalPrior
from gs2d.config.recipe import Recipe
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.losses.base import Loss, LossReport, LossView
from gs2d.losses.known_maps import Priors
from gs2d.losses.prior_formulas import Depths, PointDepths, RelativeDepths, aligned, depth_prior, normal_prior
from gs2d.render.types import RenderOutput

HIT = 0.5  # least alpha of a pixel whose depth or normal is reported
POINT_RADIUS = 0.004  # radius of a point in the report, as a fraction of the image width


def _index(view: LossView) -> int:
    if view.index is None:
        raise RecipeError("losses on known depths and normals need the index of the training view, got none")
    return view.index


@register_loss("depth_prior")
class DepthPriorLoss(Loss):
    """Relative error of known depths (docs/math.md, "Priors")."""

    settings = "depth_prior"
    title = "Known depths"
    figure = "relative error of depth, %"
    _priors: Priors
    _prior: DepthPrior

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        """Plan how known depths are read; raise DataError if the capture has none of the requested kind."""
        assert recipe.depth_prior is not None
        self._prior = recipe.depth_prior
        self._priors = Priors(scene, replace(recipe, normal_prior=None), device=device)

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the loss []; None for a view without known depths."""
        known = self._priors.at(_index(view), output.color.dtype)[0]
        if known is None:
            return None
        loss = depth_prior(known, output.depth(view.depth_kind), output.alpha, view.mask)
        return self._prior.weight_at(view.run_iteration) * loss

    def report(self, output: RenderOutput, view: LossView) -> LossReport | None:
        """Return the median error of a view, and its known and rendered depth."""
        depths = self._priors.at(_index(view), output.color.dtype)[0]
        if depths is None:
            return None
        known, error = relative_errors(depths, output.depth_mean, output.alpha > HIT)
        rendered = torch.where(output.alpha > HIT, output.depth_mean, 0).cpu().numpy()
        images = {"known depth": grown(known) if isinstance(depths, PointDepths) else known, "rendered depth": rendered}
        return LossReport(100 * float(error.median()) if len(error) else None, images)


@register_loss("normal_prior")
class NormalPriorLoss(Loss):
    """1 - cosine of rendered and known normals (docs/math.md, "Priors")."""

    settings = "normal_prior"
    title = "Known normals"
    figure = "angle between normals, degrees"
    _priors: Priors
    _prior: NormalPrior

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        """Plan how known normals are read; raise DataError if the capture has none."""
        assert recipe.normal_prior is not None
        self._prior = recipe.normal_prior
        self._priors = Priors(scene, replace(recipe, depth_prior=None), device=device)

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the loss []; None for a view without known normals."""
        known = self._priors.at(_index(view), output.color.dtype)[1]
        if known is None:
            return None
        return self._prior.weight_at(view.run_iteration) * normal_prior(known, output.normal, output.alpha, view.mask)

    def report(self, output: RenderOutput, view: LossView) -> LossReport | None:
        """Return the median angle of a view, and its known and rendered normals."""
        known = self._priors.at(_index(view), output.color.dtype)[1]
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
    """Return known depths as an image [H, W] world units (0 = unknown), and the relative errors where ``hit``."""
    if isinstance(depths, PointDepths):
        nearest = depths.pixels.gather(1, depths.weights.argmax(dim=1)[:, None])[:, 0]
        image = torch.zeros_like(rendered).reshape(-1)
        image[nearest] = depths.depth
        seen = hit.reshape(-1)[depths.pixels].all(dim=1)
        at_points = rendered.reshape(-1)[depths.pixels[seen]]
        z = 1 / (depths.weights[seen] / at_points).sum(dim=1)
        return image.reshape(rendered.shape).cpu().numpy(), (z / depths.depth[seen] - 1).abs()
    known = aligned(depths, rendered, hit) if isinstance(depths, RelativeDepths) else depths
    image = torch.where(known.valid, 1 / torch.where(known.valid, known.disparity, 1), 0)
    return image.cpu().numpy(), (rendered * known.disparity - 1).abs()[known.valid & hit]


def grown(points: np.ndarray) -> np.ndarray:
    """Return an image of single pixels with each pixel enlarged to a visible square."""
    radius = max(1, round(POINT_RADIUS * points.shape[1]))
    out = np.zeros_like(points)
    for row, column in zip(*np.nonzero(points), strict=True):
        rows = slice(max(0, row - radius), row + radius + 1)
        out[rows, max(0, column - radius) : column + radius + 1] = points[row, column]
    return out


def as_colors(normals: Tensor, cover: Tensor) -> np.ndarray:
    """Return unit normals [H, W, 3] as colours (n + 1) / 2, blended over white by their coverage [H, W]."""
    return ((0.5 * normals + 0.5) * cover[..., None] + (1 - cover[..., None])).clamp(0, 1).cpu().numpy()
