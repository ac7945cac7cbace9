"""Loss and gradients of one training view, rendered in full."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from operator import getitem

import torch
from torch import Tensor

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe, Stage
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene, View
from gs2d.errors import DivergedError
from gs2d.losses.base import LossView, compute_losses, losses_of
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.training.learned.learned_table import LearnedTable, first_not_finite_quantity, shown, shown_splats
from gs2d.training.learned.quantity import ImagePoints
from gs2d.training.robust.regularise import another_background, dropout_rate, dropped_out, rendered_splats
from gs2d.training.state import Cells, TrainState
from gs2d.training.step_result import StepResult
from gs2d.training.targets import Target, TargetSource, is_async


def raster_settings(protocol: Protocol, extent: float, sh_degree: int, mip_px: float = 0.0) -> RasterSettings:
    """Return the rasterizer settings for a scene of this extent (world units); ``mip_px`` is that of the recipe."""
    near = protocol.near_for(extent)
    # far only scales the distortion; in a large frame it keeps its default ratio to near.
    far = max(RasterSettings.far, near * RasterSettings.far / RasterSettings.near)
    return RasterSettings(
        near=near,
        far=far,
        background=protocol.background,
        sh_degree=sh_degree,
        near_plane_policy=protocol.near_plane_policy,
        mip_px=mip_px,
    ).for_depths(protocol.depth, protocol.fused_depth)


@torch.no_grad()
def visible_mask(splats: Splats, views: Sequence[View], settings: RasterSettings, backend: Backend) -> Tensor:
    """Return the splats [N] bool whose footprint reaches a pixel of any view, hidden there or not."""
    bare = replace(settings, sh_degree=0, with_distortion=False)
    visible = torch.zeros(len(splats), dtype=torch.bool, device=splats.device)
    for view in views:
        visible |= rasterize(splats, view.camera, bare, backend=backend).radii > 0
    return visible


class FullRender:
    """Renders all splats in each iteration, followed by those of ``frozen``, which get no gradients."""

    rows: Tensor | None = None

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        protocol: Protocol,
        backend: Backend,
        targets: TargetSource,
        frozen: Splats | None = None,
        learned: LearnedTable | None = None,
        cells: Cells = getitem,
    ) -> None:
        self.learned = learned or LearnedTable(recipe, scene)
        self.scene, self.recipe, self.protocol, self.backend = scene, recipe, protocol, backend
        self.frozen = frozen
        self.cells = cells  # returns the map of a view from those of ``TrainState.maps``
        self.targets = targets
        self._background = torch.tensor(protocol.background, device=backend.device)
        self.losses = losses_of(recipe)
        self.losses.prepare(scene, recipe, torch.device(backend.device))

    def settings(
        self, stage: Stage, iteration: int, background: tuple[float, float, float] | None = None
    ) -> RasterSettings:
        """Return the rasterizer settings at an iteration (1-based), over the protocol's background or another."""
        degree = stage.active_sh_degree(iteration, self.recipe.sh_degree)
        active = [term for term in stage.losses if term.is_active(iteration)]
        settings = replace(
            raster_settings(self.protocol, self.scene.extent, degree, self.recipe.mip_px),
            background=background or self.protocol.background,
            with_distortion=any("distortion" in self.losses[term].needs for term in active),
            with_transmittance_depth=False,
        )
        return settings.for_depths(*(term.depth or self.protocol.depth for term in active))

    def drawn(self, splats: Splats) -> Splats:
        """Return the splats, followed by the frozen ones."""
        return splats if self.frozen is None else splats.followed_by(self.frozen)

    def drops(self, stage: Stage) -> float:
        """Return the fraction of the splats that iterations of a stage leave out."""
        return dropout_rate(self.recipe, stage, len(self.scene.train))

    def _rendered(self, splats: Splats, state: TrainState, stage: Stage, iteration: int) -> Splats:
        """Return the splats that an iteration renders."""
        rate = self.drops(stage)
        if rate > 0:
            splats = dropped_out(splats, rendered_splats(self.recipe, state.stage, iteration, len(splats), rate))
        return self.drawn(splats)

    def camera(self, state: TrainState, index: int, *, learning: Collection[str] = ()) -> Camera:
        """Return the current camera of training view ``index``, with gradients for the quantities in ``learning``."""
        return self.learned.camera(state.learned, index, self.scene.train[index].camera, learning)

    def evaluate(
        self, state: TrainState, stage: Stage, iteration: int, index: int, probe: Tensor | None = None
    ) -> StepResult:
        """Render one view and return loss and gradients; on the CPU, raise DivergedError if they are not finite."""
        splats = state.splats
        leaves = Splats(**{k: t.detach().requires_grad_(k in stage.train) for k, t in splats.items()})
        camera = self.camera(state, index, learning=self.learned.learning(state.stage, iteration))
        another = another_background(self.recipe, stage, iteration)
        if another is not None and self.targets[index].silhouette is not None:
            another = None
        settings = self.settings(stage, iteration, another)
        rows = learning_rows(state, stage) if probe is None else None  # the signal covers all splats
        drawn, of_all = self._rendered(leaves, state, stage, iteration), probe
        rows = self._with_frozen(rows, len(splats), camera)
        if self.frozen is not None and probe is not None:
            of_all = torch.cat([probe, probe.new_zeros(len(self.frozen), probe.shape[1])])
        output = rasterize(drawn, camera, settings, backend=self.backend, screen_probe=of_all, gradient_rows=rows)
        result = self.differentiate(state, stage, iteration, index, camera, output, dict(leaves.items()))
        signal = None if probe is None else _gradient(probe)
        return replace(result, signal=signal, radii=output.radii[: len(splats)])

    def _with_frozen(self, rows: Tensor | None, count: int, camera: Camera) -> Tensor | None:
        """Extend the rows [N] with gradients by the frozen splats, which have none."""
        if self.frozen is None or camera.pose is not None:  # the gradient of a camera sums over all splats
            return rows
        own = self.frozen.means.new_ones(count, dtype=torch.bool) if rows is None else rows
        return torch.cat([own, own.new_zeros(len(self.frozen))])

    @torch.no_grad()
    def errors(
        self, state: TrainState, index: int, splats: Splats, settings: RasterSettings, *, occlusion: bool
    ) -> Tensor:
        """Return the inner sum of E_i [N] in training view ``index``, in the colours of its image."""
        camera, target = self.camera(state, index), self.targets[index]
        if self.learned.changes_color:
            numbers = self.learned.numbers(state.learned, index, splats.means)
            splats = shown_splats(splats, camera, numbers, settings.sh_degree)
            settings = replace(settings, sh_degree=0)
        options = {"backend": self.backend, "mask": target.mask, "occlusion": occlusion}
        return splat_errors(splats, camera, target.image, settings, **options)  # type: ignore[arg-type]

    def differentiate(
        self,
        state: TrainState,
        stage: Stage,
        iteration: int,
        index: int,
        camera: Camera,
        output: RenderOutput,
        leaves: Mapping[str, Tensor],
    ) -> StepResult:
        """Return the weighted losses of training view ``index``, and the gradients of the leaves that the stage trains.

        ``output`` was rendered from the ``leaves``, by attribute. Colours are compared as the training image shows
        them. Learned quantities of the image and its camera get gradients, too.

        Raise DivergedError if a loss or a gradient is not finite. Not on a GPU, where reading a value waits for the
        device: there the trainer checks losses and parameters together, before anything is reported or saved.
        """
        target = self.targets[index]
        at = ImagePoints(camera, target.silhouette, None if target.silhouette is None else self._background)
        numbers = self.learned.leaves(state.learned, index, camera, output.color)
        if numbers:
            output = replace(output, color=shown(output.color, numbers, at, clipped_pixels(target)))
        before = sum(earlier.iterations for earlier in self.recipe.stages[: state.stage])
        view = LossView(
            target.image,
            camera,
            target.mask,
            iteration,
            run_iteration=before + iteration,
            index=index,
            depth_kind=self.protocol.depth,
            silhouette=target.silhouette,
            flatness=state.bare(index, target.flatness, self.cells),
            target_mean=target.mean,
        )
        resolved = self.protocol.resolve(stage.losses)
        terms = compute_losses(output, view, resolved, backend=self.backend, losses=self.losses)
        terms |= self.learned.penalties(numbers, index)
        loss = torch.stack(list(terms.values())).sum()
        watched = not is_async(loss.device)
        values: dict[str, float | Tensor] = {
            kind: float(value.detach()) if watched else value.detach() for kind, value in terms.items()
        }
        if watched:
            check_losses(stage, iteration, values)
        if loss.requires_grad:  # False if no splat is in the image
            loss.backward()
        gradients = {name: _gradient(tensor) for name, tensor in leaves.items() if name in stage.train}
        learned = self.learned.gradients(numbers, index, camera)
        broken = first_not_finite(gradients, self.backend) if watched else None
        broken = broken or first_not_finite_quantity(learned, waits=False)
        if broken is not None:
            raise diverged(stage, iteration, f"the gradient of {broken}")
        return StepResult(values, gradients, None, None, learned=learned)


def no_view(state: TrainState, stage: Stage, probe: Tensor | None) -> StepResult:
    """Return the result of a process without a view: zeros."""
    gradients = {name: torch.zeros_like(tensor) for name, tensor in state.splats.items() if name in stage.train}
    radii = state.splats.opacity_logits.new_zeros(len(state.splats))
    return StepResult({}, gradients, None if probe is None else torch.zeros_like(probe).detach(), radii)


def clipped_pixels(target: Target) -> Tensor:
    """Return where an image is clipped [H, W, 3], except in the background of images with an alpha channel."""
    clipped = target.image >= 1
    return clipped if target.silhouette is None else clipped & (target.silhouette[..., None] > 0)


def check_losses(stage: Stage, iteration: int, losses: Mapping[str, float | Tensor]) -> dict[str, float]:
    """Return the losses as numbers; raise DivergedError if their sum is not finite."""
    values = {kind: float(value) for kind, value in losses.items()}
    if not math.isfinite(sum(values.values())):
        raise diverged(stage, iteration, f"the loss ({', '.join(f'{k} {v:g}' for k, v in values.items())})")
    return values


def learning_rows(state: TrainState, stage: Stage) -> Tensor | None:
    """Return the splats [N] bool that the stage trains; None if it trains an attribute of all splats."""
    groups = set(stage.train.values())
    if not groups or "all" in groups:
        return None
    return torch.stack([state.groups[group] for group in sorted(groups)]).any(dim=0)


def diverged(stage: Stage, iteration: int, what: str) -> DivergedError:
    """Return the error for a value that is not finite."""
    return DivergedError(
        f"training diverged at iteration {iteration} of stage {stage.name!r}: {what} is NaN or infinite; "
        f"lower a rate (--set {stage.name}.lr.means=...) or check the cameras and photographs"
    )


def _gradient(leaf: Tensor) -> Tensor:
    """Return the gradient of a leaf; zeros if the loss does not depend on it."""
    return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad


def first_not_finite(tensors: Mapping[str, Tensor], backend: Backend) -> str | None:
    """Return the name of the first tensor with a NaN or an infinity; None if all are finite."""
    number = backend.first_not_finite(list(tensors.values()))
    return None if number is None else list(tensors)[number]
