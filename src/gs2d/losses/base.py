"""The interface of losses, and the weighted losses of a rendered view.

The total loss of the official 2DGS code is 0.8 L1 + 0.2 (1 - SSIM) + lambda_n mean(1 - alpha <n, N>)
+ lambda_d mean(distortion). The weights are those of the :class:`~gs2d.config.recipe.LossTerm` of a recipe. Definitions
and gradients: ``docs/math.md``.

A loss is registered by name: a subclass of :class:`Loss`, or a function of the rendering and the :class:`LossView`.
The losses of gs2d are in ``losses.view_terms`` and ``losses.prior_terms``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from gs2d.config.loss_registry import LOSSES
from gs2d.config.recipe import LossTerm, Recipe
from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError, ShapeError
from gs2d.kernels.loss_operations import LossOperations
from gs2d.losses import formulas
from gs2d.render.backends import Backend, get_backend
from gs2d.render.types import RenderOutput

SETTINGS = ("depth_prior", "normal_prior")
"""Fields of a recipe that only losses use."""


def _operations(backend: str | Backend, device: torch.device) -> LossOperations | None:
    """Return the fused operations of a backend on a device, if it has any."""
    chosen = get_backend(backend, device.type) if isinstance(backend, str) else backend
    return chosen.loss_operations(device)


@dataclass(frozen=True, eq=False)
class LossView:
    """The training view that a rendering is compared with.

    Attributes
    ----------
    target : Tensor [H, W, 3]
        The image, in [0, 1].
    camera : Camera
        Camera of the rendering, with its ``pose`` if that learns.
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    iteration : int
        Counted from 1 within the stage.
    run_iteration : int
        Counted from 1 over all stages.
    index : int or None
        Index of the training view in ``scene.train``.
    depth_kind : "mean", "median" or "transmittance"
        Depth of the protocol; a loss sees the depth of its term: ``output.depth(view.depth_kind)``.
    silhouette : Tensor [H, W] or None
        Alpha of the image, in [0, 1], if it has an alpha channel and an active loss needs it.
    flatness : Tensor [H, W] uint8 or None
        ``formulas.flatness`` of the image, if an active loss needs it.
    target_mean : Tensor [H, W, 3] or None
        Local mean of ``target`` (``LossOperations.blur``), which saves the native SSIM one blur of four and changes no
        value.
    weights : mapping of kind to float
        Weights of the active terms, set by :func:`compute_losses`. Fused forms prepare their gradients for them.
    shared : dict
        Results that several losses of one evaluation share.
    """

    target: Tensor
    camera: Camera
    mask: Tensor | None = None
    iteration: int = 1
    run_iteration: int = 1
    index: int | None = None
    depth_kind: str = "mean"
    silhouette: Tensor | None = None
    flatness: Tensor | None = None
    target_mean: Tensor | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    shared: dict[object, Any] = field(default_factory=dict)

    def once(self, key: object, make: Callable[[], Any]) -> Any:
        """Return the shared result of this key, computed by the first loss that needs it."""
        if key not in self.shared:
            self.shared[key] = make()
        return self.shared[key]

    def check(self, output: RenderOutput) -> None:
        """Raise ShapeError if a size differs from that of the rendering."""
        images = {"color": (output.color, "H W 3"), "target": (self.target, "H W 3")}
        images |= {} if self.mask is None else {"mask": (self.mask, "H W")}
        images |= {} if self.silhouette is None else {"silhouette": (self.silhouette, "H W")}
        sizes, camera = check_shapes(images), self.camera
        if (camera.height, camera.width) != (sizes["H"], sizes["W"]):
            raise ShapeError(f"camera is {camera.width}x{camera.height}, but the image is {sizes['W']}x{sizes['H']}")


class Loss:
    """Base class of losses. There is one loss object for each kind and options of a recipe.

    The constructor takes the options of a term as keyword arguments.

    Attributes
    ----------
    needs : frozenset of str
        Entries of ``gs2d.config.loss_registry.NEEDS``: inputs that are computed or loaded only on request. A class
        sets them by ``register_loss(name, needs=...)``; an object may change its own by its options.
    settings : str or None
        Field of the recipe that must be set for this loss: "depth_prior" or "normal_prior".
    only_color : bool
        Whether the loss reads nothing of the rendering but ``color``. Stages that only train colours can then render
        from cached views.
    """

    needs: frozenset[str] = frozenset()
    settings: str | None = None
    only_color: bool = False

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        """Get ready for a scene before training begins; raise a Gs2dError if its data are missing."""

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        """Return the unweighted loss [] of a rendered view, in plain torch; None to skip the view."""
        raise NotImplementedError

    def fused(self, output: RenderOutput, view: LossView, operations: LossOperations) -> Tensor | None:
        """Return the same by the fused operations of a backend; without a form of its own, by the reference."""
        return self(output, view)

    def in_step(self, term: LossTerm, *, opaque: bool) -> Mapping[str, Any] | None:
        """Return what this loss adds to an iteration that a backend does in one piece.

        Parameters
        ----------
        term : LossTerm
            With its weight and depth resolved.
        opaque : bool
            Whether the image has no alpha channel.

        Returns
        -------
        mapping or None
            Fields of ``render.whole_step.StepLosses``; None if such an iteration cannot have this loss.
        """
        return None


class _Function(Loss):
    """A function that is registered as a loss."""

    def __init__(self, function: Callable[..., Tensor | None], **options: Any) -> None:
        self._function, self._options = function, options
        self.needs = getattr(function, "needs", frozenset())

    def __call__(self, output: RenderOutput, view: LossView) -> Tensor | None:
        return self._function(output, view, **self._options)


def _make(term: LossTerm) -> Loss:
    """Return the loss of a term with its options."""
    entry = LOSSES.get(term.kind)
    if not isinstance(entry, type):
        return _Function(entry, **term.options)
    if not issubclass(entry, Loss):
        raise RecipeError(
            f"loss {term.kind!r} must be a function or a subclass of gs2d.losses.base.Loss, got class {entry.__name__}"
        )
    try:
        loss = entry(**term.options)
    except TypeError as error:
        raise RecipeError(f"loss {term.kind!r} does not take the options {dict(term.options)}: {error}") from error
    except RecipeError as error:
        raise RecipeError(f"loss {term.kind!r}: {error}") from error
    return loss


class Losses:
    """The losses of some terms, one per kind and options; RecipeError if a loss does not take its options."""

    def __init__(self, terms: Iterable[LossTerm]) -> None:
        self._losses: dict[tuple[str, str], Loss] = {}
        for term in terms:
            if _key(term) not in self._losses:
                self._losses[_key(term)] = _make(term)

    def __getitem__(self, term: LossTerm) -> Loss:
        return self._losses[_key(term)]

    def __iter__(self) -> Iterator[tuple[str, Loss]]:
        """Iterate over kinds and losses."""
        return ((kind, loss) for (kind, _), loss in self._losses.items())

    def prepare(self, scene: Scene, recipe: Recipe, device: torch.device) -> None:
        """Prepare all of them for a scene."""
        for _, loss in self:
            loss.prepare(scene, recipe, device)


def _key(term: LossTerm) -> tuple[str, str]:
    return term.kind, json.dumps(dict(term.options), sort_keys=True, default=str) if term.options else "{}"


def losses_of(recipe: Recipe) -> Losses:
    """Return the losses of a recipe; they are not prepared.

    Raise RecipeError if a loss does not take its options, or a loss and the settings of the recipe that it needs are
    not both there.
    """
    losses, where = Losses(term for stage in recipe.stages for term in stage.losses), f"recipe {recipe.name!r}"
    used = {loss.settings for _, loss in losses}
    for kind, loss in losses:
        name = loss.settings
        if name is not None and getattr(recipe, name) is None:
            raise RecipeError(f"{where}: {name} is null, but loss {kind!r} needs it; set {name} or leave the loss out")
    for name in SETTINGS:
        if getattr(recipe, name) is not None and name not in used:
            raise RecipeError(f"{where}: {name} is set, but no loss uses it; set {name}=null or add such a loss")
    return losses


def compute_losses(
    output: RenderOutput,
    view: LossView,
    terms: Sequence[LossTerm],
    *,
    backend: str | Backend,
    losses: Losses | None = None,
) -> dict[str, Tensor]:
    """Return the weighted values of the active terms; their sum is the loss.

    Parameters
    ----------
    output : RenderOutput
    view : LossView
        Target and camera of the rendering; same dtype and device as the output.
    terms : sequence of LossTerm
        Those that are active in the iteration (``LossTerm.is_active``) are evaluated. Terms of one kind add up.
    backend : str or Backend
        Backend that rendered ``output``: its fused operations are used, if it has any.
    losses : Losses, optional
        The prepared losses of the terms; needed for losses with data of their own.

    Returns
    -------
    dict of kind to Tensor []
        weight * loss, in the order of ``terms``; without losses that skip this view.

    Raises
    ------
    ShapeError
        If target, mask or camera have another size than the image.
    RecipeError
        If a term has no weight, a loss does not take its options, or a loss is not prepared.
    BackendError
        If the backend cannot run here.
    """
    view.check(output)
    weights: dict[str, float] = {}
    active: list[tuple[LossTerm, float]] = []
    for term in terms:
        if term.weight is None:
            raise RecipeError(f"loss {term.kind!r} has no weight; resolve the recipe's losses with a protocol first")
        if term.is_active(view.iteration):
            active.append((term, term.weight))
            weights[term.kind] = weights.get(term.kind, 0.0) + term.weight
    operations = _operations(backend, output.color.device)
    if losses is None:
        losses = _unprepared([term for term, _ in active])
    values: dict[str, Tensor] = {}
    shared: dict[object, Any] = {}
    for term, weight in active:
        here = replace(view, depth_kind=term.depth or view.depth_kind, weights=weights, shared=shared)
        loss = losses[term]
        unweighted = loss(output, here) if operations is None else loss.fused(output, here, operations)
        if unweighted is not None:
            value = weight * unweighted
            values[term.kind] = values[term.kind] + value if term.kind in values else value
    return values


def _unprepared(terms: Sequence[LossTerm]) -> Losses:
    """Return losses that need no preparation."""
    losses = Losses(terms)
    for kind, loss in losses:
        if type(loss).prepare is not Loss.prepare:
            raise RecipeError(f"loss {kind!r} must be prepared for a scene; pass Losses(terms) after prepare()")
    return losses


def ssim(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    *,
    backend: str | Backend,
) -> Tensor:
    """Mean SSIM [] over valid pixels, for evaluation (the loss "ssim" is 1 minus this).

    ``image``, ``target`` [H, W, 3]. ``mask`` [H, W] bool: False = ignore this pixel.
    """
    fused = _operations(backend, image.device)
    if fused is not None:
        return fused.photometric(image, target, mask)[1]
    return formulas.ssim(image, target, mask)
