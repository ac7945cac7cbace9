"""The terms of the training loss: kind -> function, and the weighted values of the terms of a stage.

The total of official 2DGS is 0.8 L1 + 0.2 (1 - SSIM) + lambda_n mean(1 - alpha <n, N>) + lambda_d mean(distortion): the
weights are the :class:`~gs2d.config.recipe.LossTerm` of a recipe. Definitions, masks and gradients: ``docs/math.md``.

There are two implementations of each kind: plain torch (``losses.reference``), used by the reference backend, and
fused operations, native (``kernels.losses``) for the cpu backend and on the GPU (``kernels.cuda.ops``) for the cuda
backend. The backend's name chooses; nothing falls back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from types import MappingProxyType

import torch
from torch import Tensor

from gs2d.config.multiview import MULTIVIEW_KINDS
from gs2d.config.priors import PRIOR_KINDS
from gs2d.config.recipe import LossTerm
from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.errors import BackendError, RecipeError, ShapeError
from gs2d.kernels import losses as ops
from gs2d.kernels.cuda import launch
from gs2d.kernels.cuda import losses as cuda_ops
from gs2d.losses import multiview, priors, reference
from gs2d.losses.multiview import Neighbour, ViewPair
from gs2d.losses.priors import Prior
from gs2d.losses.reference import normals_from_depth
from gs2d.render.pose_gradient import normals_without_pose_grad
from gs2d.render.types import RenderOutput

__all__ = ["LOSSES", "LossInputs", "TargetMaps", "compute_losses", "normals_from_depth", "target_maps"]


@dataclass(frozen=True, eq=False)
class TargetMaps:
    """What the SSIM needs of a target alone, worth keeping per view when its target does not change.

    Attributes
    ----------
    target : Tensor [H, W, 3]
        The very tensor the maps were made of.
    mean : Tensor [H, W, 3]
        Its local Gaussian mean.
    version : int
        The target's in-place version when the maps were made.
    """

    target: Tensor
    mean: Tensor
    version: int

    def check(self, target: Tensor) -> None:
        """Raise ShapeError unless the maps were made of this tensor, unchanged since."""
        same = self.target is target or (
            self.target.data_ptr() == target.data_ptr() and self.target.shape == target.shape
        )
        if not same or target._version != self.version:
            raise ShapeError(
                "target_cache belongs to another target (or the target changed in place); make one with "
                "target_maps(target) for each view and pass the same tensor"
            )


def target_maps(target: Tensor) -> TargetMaps:
    """The maps of a target [H, W, 3] for ``compute_losses(..., target_cache=...)`` on the cpu backend."""
    check_shapes({"target": (target, "H W 3")})
    return TargetMaps(target, ops.blur(target), target._version)


@dataclass(frozen=True)
class FusedOperations:
    """The fused operations of a backend, with the signatures of ``kernels.losses``."""

    photometric: Callable[..., tuple[Tensor, Tensor]]
    normal_consistency: Callable[..., Tensor]
    masked_mean: Callable[..., Tensor]


def _fused_operations(backend_name: str, device: torch.device) -> FusedOperations | None:
    """Those of a backend on a device; None for the reference."""
    if backend_name == "cpu":
        return FusedOperations(ops.photometric, ops.normal_consistency, ops.masked_mean)
    if backend_name == "cuda":
        launcher = launch.launcher_for(device)
        return FusedOperations(
            partial(cuda_ops.photometric, launcher=launcher),
            partial(cuda_ops.normal_consistency, launcher=launcher),
            partial(cuda_ops.masked_mean, launcher=launcher),
        )
    return None


@dataclass(frozen=True, eq=False)
class LossInputs:
    """One rendered view and what it should look like.

    Attributes
    ----------
    output : RenderOutput
    target : Tensor [H, W, 3]
        In [0, 1].
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    camera : Camera
    target_mean : Tensor [H, W, 3] or None
        Local mean of the target when known (fused SSIM only).
    weights : mapping of kind to float
        Of the active terms. Not applied here: the native operations prepare their gradients for them.
    fused : FusedOperations or None
        What FUSED_LOSSES are made of; None for the reference.
    silhouette : Tensor [H, W] or None
        Alpha of the photograph, in [0, 1], if it has one.
    neighbour : Neighbour or None
        The second view of the losses that compare two.
    prior : Prior or None
        What is known of the view beforehand.
    """

    output: RenderOutput
    target: Tensor
    mask: Tensor | None
    camera: Camera
    target_mean: Tensor | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    fused: FusedOperations | None = None
    silhouette: Tensor | None = None
    neighbour: Neighbour | None = None
    prior: Prior | None = None
    _compared: dict[str, ViewPair] = field(default_factory=dict)

    def two_views(self, depth_kind: str) -> ViewPair:
        """The view beside its neighbour, by mean or median depth; shared by the losses that ask."""
        if self.neighbour is None:
            raise RecipeError("losses of two views need a neighbour, got none; pass one or take a recipe without them")
        if depth_kind not in self._compared:
            depth, output, reference = self.output.depth(depth_kind), self.output, self.neighbour.reference
            hit = (output.alpha.detach() > self.neighbour.settings.opacity) & (depth.detach() > 0)
            self._compared[depth_kind] = ViewPair(
                depth, output.normal, hit & reference.textured, self.camera, self.neighbour, self.mask
            )
        return self._compared[depth_kind]

    @cached_property
    def fused_photometric(self) -> tuple[Tensor, Tensor]:
        """(L1, SSIM) by one fused pass, shared by both terms."""
        expected = (self.weights.get("l1", 0.0), -self.weights.get("ssim", 0.0))
        return _fused(self).photometric(self.output.color, self.target, self.mask, self.target_mean, expected=expected)


LossFunction = Callable[[LossInputs, str], Tensor]
"""(inputs, "mean" or "median" depth) -> unweighted scalar."""


def _normals(inputs: LossInputs, depth_kind: str) -> tuple[Tensor, Tensor, Tensor, Camera, Tensor | None]:
    output, pose, normal = inputs.output, inputs.camera.pose, inputs.output.normal
    if pose is not None and normal.requires_grad:
        normal = normals_without_pose_grad(output, pose)  # both normals turn with the camera, which changes nothing
    return normal, output.depth(depth_kind), output.alpha, inputs.camera, inputs.mask


def _silhouette(inputs: LossInputs, _: str) -> Tensor:
    if inputs.silhouette is None:
        raise RecipeError(
            "loss 'silhouette' needs photographs with an alpha channel, got one without; take a recipe without it"
        )
    return reference.silhouette(inputs.output.alpha, inputs.silhouette, inputs.mask)


def _depth_prior(inputs: LossInputs, depth_kind: str) -> Tensor:
    if inputs.prior is None or inputs.prior.depth is None:
        raise RecipeError("loss 'depth_prior' needs known depths, got none; pass them or take a recipe without it")
    return priors.depth_prior(inputs.prior, inputs.output.depth(depth_kind), inputs.output.alpha, inputs.mask)


def _normal_prior(inputs: LossInputs, _: str) -> Tensor:
    if inputs.prior is None or inputs.prior.normal is None:
        raise RecipeError("loss 'normal_prior' needs known normals, got none; pass them or take a recipe without it")
    return priors.normal_prior(inputs.prior, inputs.output.normal, inputs.output.alpha, inputs.mask)


def _fused(inputs: LossInputs) -> FusedOperations:
    assert inputs.fused is not None
    return inputs.fused


def _fused_normals(inputs: LossInputs, depth_kind: str, kind: str) -> Tensor:
    per_splat = kind == "normal_consistency_per_splat"
    weight = inputs.weights.get(kind, 1.0)
    return _fused(inputs).normal_consistency(*_normals(inputs, depth_kind), per_splat=per_splat, expected=weight)


LOSSES: Mapping[str, LossFunction] = MappingProxyType(
    {
        "l1": lambda x, _: reference.l1(x.output.color, x.target, x.mask),
        "ssim": lambda x, _: 1 - reference.ssim(x.output.color, x.target, x.mask),
        "normal_consistency": lambda x, depth: reference.normal_consistency(*_normals(x, depth)),
        "normal_consistency_per_splat": lambda x, depth: reference.normal_consistency_per_splat(*_normals(x, depth)),
        "distortion": lambda x, _: reference.distortion(x.output.distortion, x.mask),
        "silhouette": _silhouette,
        "multiview_photometric": lambda x, depth: multiview.photometric(x.two_views(depth)),
        "multiview_geometric": lambda x, depth: multiview.geometric(x.two_views(depth)),
        "depth_prior": _depth_prior,
        "normal_prior": _normal_prior,
    }
)
"""Every kind of loss in plain torch, unweighted."""

FUSED_LOSSES: Mapping[str, LossFunction] = MappingProxyType(
    {
        "l1": lambda x, _: x.fused_photometric[0],
        "ssim": lambda x, _: 1 - x.fused_photometric[1],
        "normal_consistency": lambda x, depth: _fused_normals(x, depth, "normal_consistency"),
        "normal_consistency_per_splat": lambda x, depth: _fused_normals(x, depth, "normal_consistency_per_splat"),
        "distortion": lambda x, _: _fused(x).masked_mean(x.output.distortion, x.mask),
        "silhouette": _silhouette,  # one subtraction and a mean: not worth an operation of its own
        **{kind: LOSSES[kind] for kind in MULTIVIEW_KINDS},  # a few thousand patches
        **{kind: LOSSES[kind] for kind in PRIOR_KINDS},  # a few thousand points, or five passes over a picture
    }
)
"""The same kinds as fused operations."""

_BY_BACKEND: Mapping[str, Mapping[str, LossFunction]] = MappingProxyType(
    {"reference": LOSSES, "cpu": FUSED_LOSSES, "cuda": FUSED_LOSSES}
)


def compute_losses(
    output: RenderOutput,
    target: Tensor,
    mask: Tensor | None,
    camera: Camera,
    terms: Sequence[LossTerm],
    *,
    iteration: int,
    depth_kind: str,
    backend_name: str,
    target_cache: TargetMaps | None = None,
    silhouette: Tensor | None = None,
    neighbour: Neighbour | None = None,
    prior: Prior | None = None,
) -> dict[str, Tensor]:
    """Weighted values of the active terms; their sum is the loss.

    Parameters
    ----------
    output : RenderOutput
    target : Tensor [H, W, 3]
        In [0, 1], same dtype and device as the output.
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    camera : Camera
        That of the rendering, with its ``pose`` where that learns: the terms then say how they change with it.
    terms : sequence of LossTerm
        A term is active when ``iteration > term.start``. Terms of one kind add up.
    iteration : int
        Counted from 1 within the stage.
    depth_kind : "mean" or "median"
        The protocol's depth, for terms that name none.
    backend_name : "cpu", "cuda" or "reference"
        Resolved name of the backend that rendered ``output`` (not "auto").
    target_cache : TargetMaps, optional
        Of this target: spares the native SSIM one blur of four. It never changes the value.
    silhouette : Tensor [H, W], optional
        Alpha of the photograph, for the loss of that name.
    neighbour : Neighbour, optional
        A second view, for the losses that compare two.
    prior : Prior, optional
        What is known of the view, for the losses on known depths and normals.

    Returns
    -------
    dict of kind to Tensor []
        weight * LOSSES[kind], in the order of ``terms``.

    Raises
    ------
    ShapeError
        Target, mask or camera of another size than the image, or a cache of another target.
    RecipeError
        A kind that is not in LOSSES, a term without a weight, or a silhouette term without a silhouette.
    BackendError
        A backend without losses.
    """
    sizes = check_shapes({"color": (output.color, "H W 3"), "target": (target, "H W 3")})
    if mask is not None:
        check_shapes({"target": (target, "H W 3"), "mask": (mask, "H W")})
    if silhouette is not None:
        check_shapes({"target": (target, "H W 3"), "silhouette": (silhouette, "H W")})
    if (camera.height, camera.width) != (sizes["H"], sizes["W"]):
        raise ShapeError(f"camera is {camera.width}x{camera.height}, but the image is {sizes['W']}x{sizes['H']}")
    if backend_name not in _BY_BACKEND:
        raise BackendError(f"losses run on backend {' or '.join(map(repr, _BY_BACKEND))}, got {backend_name!r}")
    functions = _BY_BACKEND[backend_name]
    if target_cache is not None:
        target_cache.check(target)
    weights: dict[str, float] = {}
    active: list[tuple[LossTerm, float]] = []
    for term in terms:
        if term.kind not in functions:
            raise RecipeError(f"loss kind must be one of {', '.join(LOSSES)}, got {term.kind!r}")
        if term.weight is None:
            raise RecipeError(f"loss {term.kind!r} has no weight; resolve the recipe's losses with a protocol first")
        if iteration > term.start:
            active.append((term, term.weight))
            weights[term.kind] = weights.get(term.kind, 0.0) + term.weight
    mean = target_cache.mean if target_cache is not None else None
    fused = _fused_operations(backend_name, output.color.device)
    inputs = LossInputs(output, target, mask, camera, mean, weights, fused, silhouette, neighbour, prior)
    values: dict[str, Tensor] = {}
    for term, weight in active:
        value = weight * functions[term.kind](inputs, term.depth or depth_kind)
        values[term.kind] = values[term.kind] + value if term.kind in values else value
    return values


def ssim(
    image: Tensor, target: Tensor, mask: Tensor | None = None, *, backend_name: str, target_mean: Tensor | None = None
) -> Tensor:
    """Mean SSIM [] over valid pixels, for evaluation (``LOSSES["ssim"]`` is 1 minus this).

    Parameters
    ----------
    image, target : Tensor [H, W, 3]
    mask : Tensor [H, W] bool, optional
        False = ignore this pixel.
    backend_name : "cpu", "cuda" or "reference"
    target_mean : Tensor [H, W, 3], optional
        ``target_maps(target).mean``.

    Raises
    ------
    BackendError
        A backend without losses.
    """
    if backend_name not in _BY_BACKEND:
        raise BackendError(f"losses run on backend {' or '.join(map(repr, _BY_BACKEND))}, got {backend_name!r}")
    fused = _fused_operations(backend_name, image.device)
    if fused is not None:
        return fused.photometric(image, target, mask, target_mean)[1]
    return reference.ssim(image, target, mask)
