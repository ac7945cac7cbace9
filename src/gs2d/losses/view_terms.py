"""The losses of gs2d on one view: options, reference form and fused form of each.

The reference forms are the formulas of ``losses.formulas``. Definitions: ``docs/math.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from gs2d.config.loss_registry import register_loss
from gs2d.config.recipe import LossTerm
from gs2d.config.validate import one_of, require
from gs2d.errors import RecipeError
from gs2d.kernels.loss_operations import LossOperations, NormalOptions
from gs2d.losses import formulas
from gs2d.losses.base import Loss, LossView
from gs2d.losses.formulas import EDGES
from gs2d.render.pose_gradient import normals_without_pose_grad
from gs2d.render.types import RenderOutput
from gs2d.render.whole_step import StepNormals

__all__: list[str] = []  # by name only: LOSSES

WHERE = ("image", "object")


class _ColorLoss(Loss):
    """L1, SSIM and L2 have one fused pass, which returns all three."""

    only_color = True
    field: str  # of a whole step
    index: int  # in the values of the fused pass
    formula: Callable[[Tensor, Tensor, Tensor | None], Tensor]

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor:
        return self.formula(output.color, view.target, view.mask)

    def fused(self, output: RenderOutput, view: LossView, operations: LossOperations) -> Tensor:
        """Return this one of the three values."""

        def compare() -> tuple[Tensor, Tensor, Tensor]:
            weights = view.weights
            expected = (weights.get("l1", 0.0), -weights.get("ssim", 0.0), weights.get("l2", 0.0))
            return operations.photometric(output.color, view.target, view.mask, view.target_mean, expected=expected)

        value: Tensor = view.once("photometric", compare)[self.index]
        return value

    def in_step(self, term: LossTerm, *, opaque: bool) -> Mapping[str, Any]:
        """Return the weight."""
        return {self.field: float(term.weight or 0.0)}


@register_loss("l1")
class L1(_ColorLoss):
    """Mean absolute difference of colours."""

    field, index, formula = "l1", 0, staticmethod(formulas.l1)


@register_loss("ssim")
class StructuralSimilarity(_ColorLoss):
    """1 - SSIM."""

    field, index, formula = "ssim", 1, staticmethod(formulas.ssim)

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor:
        return 1 - super().__call__(output, view)

    def fused(self, output: RenderOutput, view: LossView, operations: LossOperations) -> Tensor:
        """Return 1 - SSIM of the fused pass."""
        return 1 - super().fused(output, view, operations)


@register_loss("l2")
class L2(_ColorLoss):
    """Mean squared difference of colours."""

    field, index, formula = "l2", 2, staticmethod(formulas.l2)


def _normals(output: RenderOutput, view: LossView) -> Tensor:
    """Return the rendered normals. All turn with the camera, which changes no loss: a learned pose gets no gradient."""
    pose, normal = view.camera.pose, output.normal
    return normals_without_pose_grad(output, pose) if pose is not None and normal.requires_grad else normal


@register_loss("normal_consistency")
class NormalConsistency(Loss):
    """1 - alpha <n, N> of rendered normals n and normals N of the depth map, the form of the official 2DGS code.

    ``edges``: beside empty pixels N is "undefined", or these lie at the "camera" centre as in the official code.
    ``where``: all pixels of the "image" count, or those of the "object" alone, so that covering the empty background
    earns nothing. The object is where alpha of the image is above 1/2; in images without alpha, each pixel counts by
    the rendered alpha. ``flat`` is the factor of the weight where the photograph has no texture
    (``formulas.flatness``): there colours alone do not determine the surface, and highlights mislead it.
    """

    kind, per_splat = "normal_consistency", False

    def __init__(self, edges: str = "undefined", where: str = "image", flat: float = 1.0) -> None:
        one_of("edges", edges, EDGES)
        one_of("where", where, WHERE)
        if not (math.isfinite(flat) and flat > 0):
            raise RecipeError(f"option flat of normal consistency must be a positive number, got {flat!r}")
        self.edges, self.where, self.flat = edges, where, float(flat)
        needs = {"silhouette": where == "object", "flatness": self.flat != 1}
        self.needs = frozenset(name for name, needed in needs.items() if needed)

    def _weights(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the weights [H, W] of the pixels; None if all count alike."""
        weights = None if self.where == "image" else formulas.object_weights(output.alpha, view.silhouette)
        if self.flat == 1:
            return weights
        flatness = formulas.flatness(view.target) if view.flatness is None else view.flatness
        factors = formulas.flat_weights(flatness, self.flat, output.alpha.dtype)
        return factors if weights is None else weights * factors

    def _images(self, output: RenderOutput, view: LossView) -> tuple[Tensor, Tensor, Tensor]:
        """Return normals, depth and alpha."""
        return _normals(output, view), output.depth(view.depth_kind), output.alpha

    def _plain(self, images: tuple[Tensor, Tensor, Tensor], view: LossView, weights: Tensor | None) -> Tensor:
        options = {"edges": self.edges, "weights": weights, "per_splat": self.per_splat}
        return formulas.normal_consistency(*images, view.camera, view.mask, **options)  # type: ignore[arg-type]

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor:
        return self._plain(self._images(output, view), view, self._weights(output, view))

    def fused(self, output: RenderOutput, view: LossView, operations: LossOperations) -> Tensor:
        """Return the loss by the fused operation; its gradient to intrinsics that learn comes from the reference."""
        if view.camera.rays is not None:  # the fused form is that of a pinhole
            return self(output, view)
        images, weights = self._images(output, view), self._weights(output, view)
        how = NormalOptions(view.camera, view.mask, weights, self.edges == "camera", self.per_splat)
        value = operations.normal_consistency(*images, how, expected=view.weights.get(self.kind, 1.0))
        if view.camera.intrinsics is None or not torch.is_grad_enabled():
            return value
        # The fused form takes the intrinsics for constants.
        normal, depth, alpha = (image.detach() for image in images)
        by_camera = self._plain((normal, depth, alpha), view, weights)
        return value + (by_camera - by_camera.detach())

    def in_step(self, term: LossTerm, *, opaque: bool) -> Mapping[str, Any] | None:
        """Return the weight and the options, except for depth by transmittance."""
        if self.per_splat or term.depth not in ("mean", "median"):
            return None
        at_camera, of_object = self.edges == "camera", self.where == "object"
        return {"normals": StepNormals(float(term.weight or 0.0), term.depth, at_camera, of_object, self.flat)}


@register_loss("normal_consistency_per_splat")
class NormalConsistencyPerSplat(NormalConsistency):
    """The form of the 2DGS paper, Eq. 7: alpha - <n, N>; options as of "normal_consistency"."""

    kind, per_splat = "normal_consistency_per_splat", True


@register_loss("normal_smoothness", needs=["flatness"])
class NormalSmoothness(Loss):
    """Total variation of the rendered normals where the photograph has no texture.

    There colours alone do not determine the surface, and highlights mislead it.
    """

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor:
        return formulas.normal_smoothness(*self._images(output, view), view.mask)

    def fused(self, output: RenderOutput, view: LossView, operations: LossOperations) -> Tensor:
        """Return the loss by the fused operation."""
        expected = view.weights.get("normal_smoothness", 1.0)
        return operations.normal_smoothness(*self._images(output, view), view.mask, expected=expected)

    def in_step(self, term: LossTerm, *, opaque: bool) -> Mapping[str, Any]:
        """Return the weight."""
        return {"smooth_normals": float(term.weight or 0.0)}

    @staticmethod
    def _images(output: RenderOutput, view: LossView) -> tuple[Tensor, Tensor, Tensor]:
        flatness = formulas.flatness(view.target) if view.flatness is None else view.flatness
        return _normals(output, view), output.alpha, flatness


@register_loss("distortion", needs=["distortion"])
class Distortion(Loss):
    """Mean of the distortion map."""

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor:
        return formulas.masked_mean(output.distortion, view.mask)

    def fused(self, output: RenderOutput, view: LossView, operations: LossOperations) -> Tensor:
        """Return the mean by the fused operation."""
        return operations.masked_mean(output.distortion, view.mask)


@register_loss("silhouette", needs=["silhouette"])
class SilhouetteLoss(Loss):
    """Absolute difference of the rendered alpha and that of the image.

    Images without an alpha channel skip the loss, unless one is ``required``.
    """

    def __init__(self, required: bool = True) -> None:
        require(isinstance(required, bool), f"required must be true or false, got {required!r}")
        self._required = required

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        if view.silhouette is None and self._required:
            raise RecipeError(
                "loss 'silhouette' needs photographs with an alpha channel, got one without; use a recipe without it"
            )
        return None if view.silhouette is None else formulas.silhouette(output.alpha, view.silhouette, view.mask)

    def in_step(self, term: LossTerm, *, opaque: bool) -> Mapping[str, Any] | None:
        """Return the weight, for images with an alpha channel."""
        if opaque:
            return None if self._required else {}
        return {"silhouette": float(term.weight or 0.0)}
