"""The terms of the training loss: what a loss is, gs2d's own, and the weighted values of the terms of a stage.

The total of official 2DGS is 0.8 L1 + 0.2 (1 - SSIM) + lambda_n mean(1 - alpha <n, N>) + lambda_d mean(distortion): the
weights are the :class:`~gs2d.config.recipe.LossTerm` of a recipe. Definitions, masks and gradients: ``docs/math.md``.

A loss is a function of what was rendered and of the :class:`LossView`, registered by name: gs2d's own in plain torch
here, by the formulas of ``losses.reference``. For some a backend has fused operations (``Backend.loss_operations``);
nothing falls back.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from gs2d.config.losses import LOSSES, register_loss
from gs2d.config.recipe import LossTerm, Recipe
from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError, ShapeError
from gs2d.kernels.losses import LossOperations
from gs2d.losses import multiview, reference
from gs2d.losses.multiview import CompareViews, Neighbour, ViewPair
from gs2d.losses.reference import normals_from_depth
from gs2d.render.backends import Backend, get_backend
from gs2d.render.pose_gradient import normals_without_pose_grad
from gs2d.render.types import RenderOutput

__all__ = [
    "LOSSES",
    "Loss",
    "LossFunction",
    "LossReport",
    "LossView",
    "TargetMaps",
    "compute_losses",
    "loss_of",
    "needs_of",
    "normals_from_depth",
    "prepared",
    "register_loss",
    "ssim",
    "target_maps",
]


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


def target_maps(target: Tensor, backend: str | Backend = "cpu") -> TargetMaps | None:
    """Make a target's maps ([H, W, 3]) for ``compute_losses(..., target_cache=...)``; None: the backend takes none."""
    check_shapes({"target": (target, "H W 3")})
    operations = _operations(backend, target.device)
    if operations is None or operations.blur is None:
        return None
    return TargetMaps(target, operations.blur(target), target._version)


def _operations(backend: str | Backend, device: torch.device) -> LossOperations | None:
    """Return the fused operations of a backend on a device, where it has any."""
    chosen = get_backend(backend, device.type) if isinstance(backend, str) else backend
    return chosen.loss_operations(device)


@dataclass(eq=False)
class LossView:
    """What a rendered view should look like, and all else that a loss may want to know of it.

    Attributes
    ----------
    target : Tensor [H, W, 3]
        The photograph, in [0, 1].
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    camera : Camera
    iteration : int
        Counted from 1 within the stage.
    depth_kind : "mean", "median" or "transmittance"
        The depth that the term asks for: ``output.depth(view.depth_kind)``.
    edges : "undefined" or "camera"
        How the term takes normals of depth beside empty pixels: ``LossTerm.edges``.
    pixel_weights : Tensor [H, W] or None
        By which the term multiplies the part of each pixel, for ``LossTerm.where`` and ``edge_power``.
    run_iteration : int
        Counted from 1 over all stages.
    index : int or None
        Of the training view, in the order of ``scene.train``.
    silhouette : Tensor [H, W] or None
        Alpha of the photograph, in [0, 1], if it has one and an active loss needs it.
    neighbour : Neighbour or None
        The second view, for losses that need it.
    target_mean : Tensor [H, W, 3] or None
        Local mean of the target when known (fused SSIM only).
    weights : mapping of kind to float
        Of the active terms. Not applied here: the native operations prepare their gradients for them.
    fused : LossOperations or None
        The fused operations of the backend, where it has any.
    """

    target: Tensor
    mask: Tensor | None
    camera: Camera
    iteration: int = 1
    depth_kind: str = "mean"
    edges: str = "undefined"
    pixel_weights: Tensor | None = None
    run_iteration: int = 1
    index: int | None = None
    silhouette: Tensor | None = None
    neighbour: Neighbour | None = None
    target_mean: Tensor | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    fused: LossOperations | None = None
    _compared: dict[str, ViewPair] = field(default_factory=dict)
    _fused_views: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict)
    _photometric: tuple[Tensor, Tensor, Tensor] | None = None

    def two_views(self, output: RenderOutput) -> ViewPair:
        """Return the view beside its neighbour, by one kind of depth; shared by the losses that ask."""
        if self.neighbour is None:
            raise RecipeError("losses of two views need a neighbour, got none; pass one or take a recipe without them")
        kind = self.depth_kind
        if kind not in self._compared:
            depth, reference = output.depth(kind), self.neighbour.reference
            hit = (output.alpha.detach() > self.neighbour.settings.opacity) & (depth.detach() > 0)
            self._compared[kind] = ViewPair(
                depth, output.normal, hit & reference.textured, self.camera, self.neighbour, self.mask
            )
        return self._compared[kind]

    def compared(self, output: RenderOutput, compare: CompareViews) -> tuple[Tensor, Tensor]:
        """Return both losses of two views by one operation, shared by the terms of a kind of depth."""
        if self.depth_kind not in self._fused_views:
            self._fused_views[self.depth_kind] = self.two_views(output).compared(compare)
        return self._fused_views[self.depth_kind]

    def photometric(self, output: RenderOutput, operations: LossOperations) -> tuple[Tensor, Tensor, Tensor]:
        """Return (L1, SSIM, L2) by one fused pass, shared by their terms."""
        if self._photometric is None:
            expected = (self.weights.get("l1", 0.0), -self.weights.get("ssim", 0.0), self.weights.get("l2", 0.0))
            given = (output.color, self.target, self.mask, self.target_mean)
            self._photometric = operations.photometric(*given, expected=expected)
        return self._photometric


LossFunction = Callable[[RenderOutput, LossView], Tensor | None]
"""(rendered view, what it should look like) -> unweighted scalar; None where it has nothing to say of this view."""


@dataclass(frozen=True, eq=False)
class LossReport:
    """What a loss has to say of a training view after a stage, for ``metrics.json`` and the report.

    Attributes
    ----------
    figure : float or None
        Compared over the views: the report says their median, and plots it by photograph.
    images : mapping of title to array
        Shown for a few views: colours [H, W, 3] in [0, 1], or depths [H, W] in world units, 0 = unknown, which share
        one scale.
    """

    figure: float | None = None
    images: Mapping[str, np.ndarray] = field(default_factory=dict)


class Loss(Protocol):
    """A loss with data of its own: a class is registered, and made once for each kind and options of a recipe.

    Its constructor takes the term's options as keyword arguments. With a method ``report(output, view)`` that returns a
    :class:`LossReport`, or None, it has a section in the report of the run; ``title`` (str) is its heading, and
    ``figure`` (str) says what the figure is: "error of depth, %".
    """

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        """Get ready for a scene before training begins; raise a Gs2dError where it lacks what is needed."""

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the unweighted loss [] of a rendered view; None where there is nothing to say of it."""


def prepared(term: LossTerm, scene: Scene, recipe: Recipe, device: torch.device) -> LossFunction:
    """Return the function of a term, made with its options and, if it is a class, prepared for a scene.

    Raises
    ------
    RecipeError
        Options that it does not take.
    """
    made = LOSSES.get(term.kind)
    try:
        if not isinstance(made, type):
            return partial(made, **term.options) if term.options else made
        loss = made(**term.options)
    except TypeError as error:
        raise RecipeError(f"loss {term.kind!r} does not take the options {dict(term.options)}: {error}") from error
    loss.prepare(scene, recipe, device)
    return loss


def needs_of(term: LossTerm) -> frozenset[str]:
    """Return the entries of ``gs2d.config.losses.NEEDS`` that a term needs."""
    needs: frozenset[str] = getattr(LOSSES.get(term.kind), "needs", frozenset())
    return needs | {"silhouette"} if term.where == "object" else needs


def loss_of(term: LossTerm) -> tuple[str, str]:
    """Return what a term's function is known by: its kind and its options."""
    return term.kind, json.dumps(dict(term.options), sort_keys=True, default=str)


def _pixel_weights(term: LossTerm, output: RenderOutput, view: LossView) -> Tensor | None:
    """Return the weights [H, W] that a term gives to pixels; None where all count alike."""
    weights = None if term.where == "image" else reference.object_weights(output.alpha, view.silhouette)
    if term.edge_power > 0:
        of_edges = reference.edge_weights(view.target, term.edge_power, view.mask)
        weights = of_edges if weights is None else weights * of_edges
    return weights


def _normals(output: RenderOutput, view: LossView) -> tuple[Tensor, Tensor, Tensor, Camera, Tensor | None]:
    pose, normal = view.camera.pose, output.normal
    if pose is not None and normal.requires_grad:
        normal = normals_without_pose_grad(output, pose)  # both normals turn with the camera, which changes nothing
    return normal, output.depth(view.depth_kind), output.alpha, view.camera, view.mask


@register_loss("l1")
def _l1(output: RenderOutput, view: LossView) -> Tensor:
    return reference.l1(output.color, view.target, view.mask)


@register_loss("l2")
def _l2(output: RenderOutput, view: LossView) -> Tensor:
    return reference.l2(output.color, view.target, view.mask)


@register_loss("ssim")
def _ssim(output: RenderOutput, view: LossView) -> Tensor:
    return 1 - reference.ssim(output.color, view.target, view.mask)


@register_loss("normal_consistency")
def _normal_consistency(output: RenderOutput, view: LossView) -> Tensor:
    return reference.normal_consistency(*_normals(output, view), edges=view.edges, weights=view.pixel_weights)


@register_loss("normal_consistency_per_splat")
def _normal_consistency_per_splat(output: RenderOutput, view: LossView) -> Tensor:
    return reference.normal_consistency_per_splat(*_normals(output, view), edges=view.edges, weights=view.pixel_weights)


@register_loss("distortion", needs=["distortion"])
def _distortion(output: RenderOutput, view: LossView) -> Tensor:
    return reference.distortion(output.distortion, view.mask)


@register_loss("silhouette", needs=["silhouette"])
def _silhouette(output: RenderOutput, view: LossView) -> Tensor:
    if view.silhouette is None:
        raise RecipeError(
            "loss 'silhouette' needs photographs with an alpha channel, got one without; take a recipe without it"
        )
    return reference.silhouette(output.alpha, view.silhouette, view.mask)


@register_loss("multiview_photometric", needs=["neighbour"])
def _multiview_photometric(output: RenderOutput, view: LossView) -> Tensor:
    if view.fused is not None and view.fused.compare_views is not None:
        return view.compared(output, view.fused.compare_views)[0]
    return multiview.photometric(view.two_views(output))


@register_loss("multiview_geometric", needs=["neighbour"])
def _multiview_geometric(output: RenderOutput, view: LossView) -> Tensor:
    if view.fused is not None and view.fused.compare_views is not None:
        return view.compared(output, view.fused.compare_views)[1]
    return multiview.geometric(view.two_views(output))


def _fused_normals(output: RenderOutput, view: LossView, operations: LossOperations, kind: str) -> Tensor:
    per_splat, weight = kind == "normal_consistency_per_splat", view.weights.get(kind, 1.0)
    choices: dict[str, Any] = {"edges": view.edges, "weights": view.pixel_weights}
    images = _normals(output, view)
    value = operations.normal_consistency(*images, **choices, per_splat=per_splat, expected=weight)
    if view.camera.intrinsics is None or not torch.is_grad_enabled():
        return value
    # The fused one takes the intrinsics for constants; what the normals of the depth image owe to them is added.
    normal, depth, alpha, camera, mask = images
    plain = reference.normal_consistency_per_splat if per_splat else reference.normal_consistency
    by_camera = plain(normal.detach(), depth.detach(), alpha.detach(), camera, mask, **choices)
    return value + (by_camera - by_camera.detach())


FUSED: Mapping[str, Callable[[RenderOutput, LossView, LossOperations], Tensor]] = MappingProxyType(
    {
        "l1": lambda output, view, fused: view.photometric(output, fused)[0],
        "ssim": lambda output, view, fused: 1 - view.photometric(output, fused)[1],
        "l2": lambda output, view, fused: view.photometric(output, fused)[2],
        "normal_consistency": partial(_fused_normals, kind="normal_consistency"),
        "normal_consistency_per_splat": partial(_fused_normals, kind="normal_consistency_per_splat"),
        "distortion": lambda output, view, fused: fused.masked_mean(output.distortion, view.mask),
    }
)
"""The losses that every backend with fused operations has; for those of two views it may. The rest is not worth any
(docs/notebook/performance.md)."""


def compute_losses(
    output: RenderOutput,
    target: Tensor,
    mask: Tensor | None,
    camera: Camera,
    terms: Sequence[LossTerm],
    *,
    iteration: int,
    depth_kind: str,
    backend: str | Backend,
    target_cache: TargetMaps | None = None,
    silhouette: Tensor | None = None,
    neighbour: Neighbour | None = None,
    index: int | None = None,
    run_iteration: int | None = None,
    functions: Mapping[tuple[str, str], LossFunction] | None = None,
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
        Those that are active in the iteration (``LossTerm.is_active``) are evaluated. Terms of one kind add up.
    iteration : int
        Counted from 1 within the stage.
    depth_kind : "mean", "median" or "transmittance"
        The protocol's depth, for terms that name none.
    backend : str or Backend
        That rendered ``output``: its fused operations are taken, where it has any.
    target_cache : TargetMaps, optional
        Of this target: spares the native SSIM one blur of four. It never changes the value.
    silhouette : Tensor [H, W], optional
        Alpha of the photograph, for the loss of that name and for terms that are asked of the object.
    neighbour : Neighbour, optional
        A second view, for the losses that compare two.
    index : int, optional
        Of the training view, for losses with data of their own.
    run_iteration : int, optional
        ``iteration`` counted over all stages; by default the same.
    functions : mapping, optional
        By :func:`loss_of` the functions of terms with data of their own, which :func:`prepared` makes.

    Returns
    -------
    dict of kind to Tensor []
        weight * loss, in the order of ``terms``; without those that have nothing to say of this view.

    Raises
    ------
    ShapeError
        Target, mask or camera of another size than the image, or a cache of another target.
    RecipeError
        A kind that nobody has registered, a term without a weight, or a silhouette term without a silhouette.
    BackendError
        The backend cannot run here.
    """
    sizes = check_shapes({"color": (output.color, "H W 3"), "target": (target, "H W 3")})
    if mask is not None:
        check_shapes({"target": (target, "H W 3"), "mask": (mask, "H W")})
    if silhouette is not None:
        check_shapes({"target": (target, "H W 3"), "silhouette": (silhouette, "H W")})
    if (camera.height, camera.width) != (sizes["H"], sizes["W"]):
        raise ShapeError(f"camera is {camera.width}x{camera.height}, but the image is {sizes['W']}x{sizes['H']}")
    if target_cache is not None:
        target_cache.check(target)
    weights: dict[str, float] = {}
    active: list[tuple[LossTerm, float]] = []
    for term in terms:
        if term.weight is None:
            raise RecipeError(f"loss {term.kind!r} has no weight; resolve the recipe's losses with a protocol first")
        if term.is_active(iteration):
            active.append((term, term.weight))
            weights[term.kind] = weights.get(term.kind, 0.0) + term.weight
    view = LossView(
        target,
        mask,
        camera,
        iteration,
        run_iteration=iteration if run_iteration is None else run_iteration,
        index=index,
        silhouette=silhouette,
        neighbour=neighbour,
        target_mean=None if target_cache is None else target_cache.mean,
        weights=weights,
        fused=_operations(backend, output.color.device),
    )
    values: dict[str, Tensor] = {}
    for term, weight in active:
        view.depth_kind, view.edges = term.depth or depth_kind, term.edges
        view.pixel_weights = _pixel_weights(term, output, view)
        found = _value(term, output, view, functions or {})
        if found is not None:
            value = weight * found
            values[term.kind] = values[term.kind] + value if term.kind in values else value
    return values


def _value(
    term: LossTerm, output: RenderOutput, view: LossView, functions: Mapping[tuple[str, str], LossFunction]
) -> Tensor | None:
    """Return the unweighted value of a term; None where this photograph does without."""
    if not term.required and view.silhouette is None:
        return None
    if view.fused is not None and term.kind in FUSED:
        return FUSED[term.kind](output, view, view.fused)
    function = functions.get(loss_of(term)) if functions else None
    if function is None:
        function = LOSSES.get(term.kind)
        if isinstance(function, type):
            raise RecipeError(f"loss {term.kind!r} has data of its own; pass what prepared() makes as `functions`")
        function = partial(function, **term.options) if term.options else function
    value: Tensor | None = function(output, view)
    return value


def ssim(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    *,
    backend: str | Backend,
    target_mean: Tensor | None = None,
) -> Tensor:
    """Mean SSIM [] over valid pixels, for evaluation (the loss "ssim" is 1 minus this).

    Parameters
    ----------
    image, target : Tensor [H, W, 3]
    mask : Tensor [H, W] bool, optional
        False = ignore this pixel.
    backend : str or Backend
    target_mean : Tensor [H, W, 3], optional
        ``target_maps(target).mean``.

    Raises
    ------
    BackendError
        The backend cannot run here.
    """
    fused = _operations(backend, image.device)
    if fused is not None:
        return fused.photometric(image, target, mask, target_mean)[1]
    return reference.ssim(image, target, mask)
