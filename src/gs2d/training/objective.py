"""Loss and gradients of one training view, by rendering all of it."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol as Interface

import torch
from torch import Tensor

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe, Stage
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene, View
from gs2d.errors import DivergedError
from gs2d.losses.api import LossReport, LossView, compute_losses, losses_of
from gs2d.losses.multiview import Neighbour
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.training.dropout import dropout_rate, dropped_out, kept_splats
from gs2d.training.learned.appearance import shown, shown_splats
from gs2d.training.learned.learned_table import LearnedTable, first_not_finite_quantity
from gs2d.training.learned.quantity import ImagePoints
from gs2d.training.multiview import PATCH_BYTES, ImageFiles, draw_turn, find_neighbours
from gs2d.training.opaque import another_background
from gs2d.training.state import TrainState
from gs2d.training.targets import Target, TargetSource


def raster_settings(protocol: Protocol, extent: float, sh_degree: int) -> RasterSettings:
    """Return the rasterizer's constants for a scene of this extent (world units) under a protocol."""
    near = protocol.near_for(extent)
    # far only scales the distortion; in a large frame it keeps the ratio to near that 0.2 and 100 have.
    far = max(RasterSettings.far, near * RasterSettings.far / RasterSettings.near)
    return RasterSettings(
        near=near,
        far=far,
        background=protocol.background,
        sh_degree=sh_degree,
        near_plane_policy=protocol.near_plane_policy,
    ).for_depths(protocol.depth, protocol.fused_depth)


@torch.no_grad()
def visible_mask(splats: Splats, views: Sequence[View], settings: RasterSettings, backend: Backend) -> Tensor:
    """Splats [N] bool whose footprint reaches a pixel of some view, hidden there or not."""
    bare = replace(settings, sh_degree=0, with_distortion=False)
    seen = torch.zeros(len(splats), dtype=torch.bool, device=splats.device)
    for view in views:
        seen |= rasterize(splats, view.camera, bare, backend=backend).radii > 0
    return seen


@dataclass(frozen=True, eq=False)
class StepResult:
    """Loss terms of one iteration with the gradients of the trained attributes and, if gathered, screen gradients.

    Attributes
    ----------
    losses : mapping of kind to float or Tensor []
        Weighted. Tensors on a GPU: to read them is to wait for it.
    gradients : mapping of attribute to Tensor
        Like the attributes; only of ``rows``, in their order, where those are given.
    signal : Tensor [N, 2] or [N, 4], or None
    radii : Tensor [N] px or None
        None where nothing was projected.
    rows : Tensor [M] int64 or None
    learned : mapping of name to Tensor
        Gradients of what is learned of the image and its camera (``gs2d.training.learned``).
    """

    losses: Mapping[str, float | Tensor]
    gradients: Mapping[str, Tensor]
    signal: Tensor | None
    radii: Tensor | None
    rows: Tensor | None = None
    learned: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ViewResidual:
    """How a rendered training view differs from its photograph.

    Attributes
    ----------
    error : Tensor [H, W]
        Mean absolute difference of the channels; 0 where a mask says that the pixel does not count.
    camera : Camera
        That it was seen by, and ``settings`` that it was rendered with.
    settings : RasterSettings
    frozen : Splats or None
        Splats that were rendered too, and are not in training.
    """

    error: Tensor
    camera: Camera
    settings: RasterSettings
    frozen: Splats | None = None


class Objective(Interface):
    """How a stage gets the loss and the gradients of a view.

    ``rows`` [M] int64 are those of which gradients may come alone; None: they come of all.
    """

    rows: Tensor | None

    def evaluate(
        self, state: TrainState, stage: Stage, iteration: int, index: int, probe: Tensor | None = None
    ) -> StepResult:
        """Loss and gradients of a training view, and of a screen probe; checked to be finite (DivergedError)."""


class FullRender:
    """Every splat is rendered each time, and with them those of ``frozen``, which stay as they are."""

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
    ) -> None:
        self.learned = learned or LearnedTable(recipe, scene)
        self.scene, self.recipe, self.protocol, self.backend = scene, recipe, protocol, backend
        self.frozen = frozen
        self.targets = targets
        self._background = torch.tensor(protocol.background, device=backend.device)
        self.losses = losses_of(recipe)
        if recipe.multiview is not None:
            self._neighbours = find_neighbours(scene, recipe.multiview)
            limit = 0 if scene.ahead else PATCH_BYTES
            self._images = ImageFiles(scene.train, recipe.multiview, limit_bytes=limit)
        self.losses.prepare(scene, recipe, torch.device(backend.device))

    def settings(
        self, stage: Stage, iteration: int, background: tuple[float, float, float] | None = None
    ) -> RasterSettings:
        """Return the rasterizer's constants at an iteration (1-based), over the protocol's background or another."""
        degree = stage.active_sh_degree(iteration, self.recipe.sh_degree)
        active = [term for term in stage.losses if term.is_active(iteration)]
        settings = replace(
            raster_settings(self.protocol, self.scene.extent, degree),
            background=background or self.protocol.background,
            with_distortion=bool(self.losses.needing("distortion", active)),
            with_transmittance_depth=False,
        )
        return settings.for_depths(*(term.depth or self.protocol.depth for term in active))

    def drawn(self, splats: Splats) -> Splats:
        """Return the splats, and in rows behind them those that are frozen: what photographs show."""
        return splats if self.frozen is None else splats.followed_by(self.frozen)

    def drops(self, stage: Stage) -> float:
        """Return the part of the splats that iterations of a stage leave out."""
        return dropout_rate(self.recipe, stage, len(self.scene.train))

    def _left(self, splats: Splats, state: TrainState, stage: Stage, iteration: int) -> Splats:
        """Return what an iteration draws: all but those of the splats that it leaves out."""
        rate = self.drops(stage)
        if rate > 0:
            splats = dropped_out(splats, kept_splats(self.recipe, state.stage, iteration, len(splats), rate))
        return self.drawn(splats)

    def camera(self, state: TrainState, index: int, *, learning: Collection[str] = ()) -> Camera:
        """Return the camera of training view ``index`` where it is now; with gradients of what is ``learning``."""
        return self.learned.camera(state.learned, index, self.scene.train[index].camera, learning)

    def _seen(self, state: TrainState, index: int) -> tuple[Camera, Target]:
        """Return the camera of a view and its photograph, as a rendering of that camera would show it."""
        camera = self.camera(state, index)
        return camera, self.learned.target(state.learned, index, camera, self.targets[index])

    def evaluate(
        self, state: TrainState, stage: Stage, iteration: int, index: int, probe: Tensor | None = None
    ) -> StepResult:
        """Render one view; loss and gradients, checked to be finite (DivergedError; not on a GPU)."""
        splats = state.splats
        leaves = Splats(**{k: t.detach().requires_grad_(k in stage.train) for k, t in splats.items()})
        camera = self.camera(state, index, learning=self.learned.learning(state.stage, iteration))
        another = another_background(self.recipe, stage, iteration)
        if another is not None and self.targets[index].silhouette is not None:
            another = None
        settings = self.settings(stage, iteration, another)
        rows = learning_rows(state, stage) if probe is None else None  # the signal is of every splat
        drawn, of_all = self._left(leaves, state, stage, iteration), probe
        rows = self._with_frozen(rows, len(splats), camera)
        if self.frozen is not None and probe is not None:
            of_all = torch.cat([probe, probe.new_zeros(len(self.frozen), probe.shape[1])])
        output = rasterize(drawn, camera, settings, backend=self.backend, screen_probe=of_all, gradient_rows=rows)
        neighbour = self.neighbour_of(state, stage, iteration, index, splats)
        given = (index, camera, output, dict(leaves.items()), neighbour)
        found = self.differentiate(state, stage, iteration, *given)
        signal = None if probe is None else _gradient(probe)
        return replace(found, signal=signal, radii=output.radii[: len(splats)])

    def _with_frozen(self, rows: Tensor | None, count: int, camera: Camera) -> Tensor | None:
        """Return the rows [N + frozen] that have gradients, of those [N] among ``count`` splats in training."""
        if self.frozen is None or camera.pose is not None:  # a camera's gradient is a sum over all splats
            return rows
        own = self.frozen.means.new_ones(count, dtype=torch.bool) if rows is None else rows
        return torch.cat([own, own.new_zeros(len(self.frozen))])

    @torch.no_grad()
    def residual(self, state: TrainState, stage: Stage, iteration: int, index: int) -> ViewResidual:
        """Render view ``index`` as it is trained on at an iteration (from 1), beside its photograph."""
        camera, target = self._seen(state, index)
        settings = replace(self.settings(stage, iteration), with_distortion=False)
        color = rasterize(self.drawn(state.splats), camera, settings, backend=self.backend).color
        numbers = self.learned.numbers(state.learned, index, color)
        color = shown(color, numbers, self._points(camera, target), clipped_pixels(target))
        error = (color - target.image).abs().mean(dim=2)
        error = error if target.mask is None else error * target.mask
        return ViewResidual(error, camera, settings, self.frozen)

    @torch.no_grad()
    def errors(
        self, state: TrainState, index: int, splats: Splats, settings: RasterSettings, *, occlusion: bool
    ) -> Tensor:
        """Return the inner sum of E_i of splats [N] in training view ``index``, in the colours that it shows."""
        camera, target = self._seen(state, index)
        if self.learned.changes_color:
            numbers = self.learned.numbers(state.learned, index, splats.means)
            splats = shown_splats(splats, camera, numbers, settings.sh_degree)
            settings = replace(settings, sh_degree=0)
        given = {"backend": self.backend, "mask": target.mask, "occlusion": occlusion}
        return splat_errors(splats, camera, target.image, settings, **given)  # type: ignore[arg-type]

    def _points(self, camera: Camera, target: Target) -> ImagePoints:
        """Return the pixels of a photograph."""
        return ImagePoints(camera, target.silhouette, None if target.silhouette is None else self._background)

    @torch.no_grad()
    def neighbour_of(
        self, state: TrainState, stage: Stage, iteration: int, index: int, splats: Splats
    ) -> Neighbour | None:
        """Return the view that view ``index`` is compared with in an iteration, rendered; None: with none."""
        settings, terms = self.recipe.multiview, self.losses.needing("neighbour", stage.losses)
        if settings is None or not any(term.weight and term.is_active(iteration) for term in terms):
            return None
        turn = draw_turn(self.recipe, state.stage, iteration, self._neighbours[index], settings)
        if turn is None:
            return None
        camera, other = self.camera(state, turn.neighbour), turn.neighbour
        kind = next((term.depth for term in terms if term.depth), self.protocol.depth)
        bare = replace(self.settings(stage, iteration), sh_degree=0, with_distortion=False).for_depths(kind)
        small = camera.resized(*(-(-n // settings.depth_downscale) for n in (camera.width, camera.height)))
        depth = rasterize(self.drawn(splats), small, bare, backend=self.backend).depth(kind)
        here, there = (self._images.of(i, self.targets[i]) for i in (index, other))
        return Neighbour(here, there, camera, depth, turn.draws.to(depth.device, non_blocking=True), settings)

    @torch.no_grad()
    def report(
        self, state: TrainState, index: int, settings: RasterSettings, backend: Backend
    ) -> dict[str, LossReport]:
        """Return what the losses say of training view ``index`` as it is now."""
        camera, target = self.camera(state, index), self.targets[index]
        output = rasterize(self.drawn(state.splats), camera, settings, backend=backend)
        view = LossView(
            target.image,
            camera,
            target.mask,
            index=index,
            depth_kind=self.protocol.depth,
            silhouette=target.silhouette,
        )
        reports = {name: loss.report(output, view) for name, loss in self.losses.reporters.items()}
        return {name: report for name, report in reports.items() if report is not None}

    def differentiate(
        self,
        state: TrainState,
        stage: Stage,
        iteration: int,
        index: int,
        camera: Camera,
        output: RenderOutput,
        leaves: Mapping[str, Tensor],
        neighbour: Neighbour | None = None,
    ) -> StepResult:
        """Weighted loss terms of a rendered view, and the gradients of the leaves that the stage trains.

        Colours are compared as the photograph shows them. What is learned of the image and of its camera has gradients,
        too; that of the camera if it is the one that ``output`` was rendered by.

        Raises
        ------
        DivergedError
            If one of them is not finite. On a GPU nothing is looked at here, because a look waits for the device; the
            trainer looks at losses and parameters together, before anything is reported or saved.
        """
        target = self.targets[index]
        at = self._points(camera, target)
        numbers = self.learned.leaves(state.learned, index, camera, output.color)
        if numbers:
            color = shown(output.color, numbers, at, clipped_pixels(target))
            if at.inside is not None:  # what the rendering does not reach teaches nothing
                color = torch.where(at.inside[..., None], color, target.image)
            output = replace(output, color=color)
        view = LossView(
            target.image,
            camera,
            target.mask,
            iteration=iteration,
            run_iteration=sum(earlier.iterations for earlier in self.recipe.stages[: state.stage]) + iteration,
            index=index,
            depth_kind=self.protocol.depth,
            silhouette=target.silhouette,
            neighbour=neighbour,
            maps=target.maps,
        )
        resolved = self.protocol.resolve(stage.losses)
        if neighbour is None:
            compared = self.losses.needing("neighbour", resolved)
            resolved = tuple(term for term in resolved if term not in compared)
        terms = compute_losses(output, view, resolved, backend=self.backend, losses=self.losses)
        terms |= self.learned.penalties(numbers, index)
        loss = torch.stack(list(terms.values())).sum()
        watched = not is_async(loss.device)
        values: dict[str, float | Tensor] = {
            kind: float(value.detach()) if watched else value.detach() for kind, value in terms.items()
        }
        if watched:
            check_losses(stage, iteration, values)
        if loss.requires_grad:  # not where no splat is in the picture
            loss.backward()
        gradients = {name: _gradient(tensor) for name, tensor in leaves.items() if name in stage.train}
        learned = self.learned.gradients(numbers, index, camera)
        broken = first_not_finite(gradients, self.backend) if watched else None
        broken = broken or first_not_finite_quantity(learned, waits=False)
        if broken is not None:
            raise diverged(stage, iteration, f"the gradient of {broken}")
        return StepResult(values, gradients, None, None, learned=learned)


def no_view(state: TrainState, stage: Stage, probe: Tensor | None) -> StepResult:
    """Return the result of an iteration that shows nothing: zeros."""
    gradients = {name: torch.zeros_like(tensor) for name, tensor in state.splats.items() if name in stage.train}
    radii = state.splats.opacity_logits.new_zeros(len(state.splats))
    return StepResult({}, gradients, None if probe is None else torch.zeros_like(probe).detach(), radii)


def clipped_pixels(target: Target) -> Tensor:
    """Where a photograph is at its ceiling [H, W, 3]; not in the white that is put behind one with an alpha channel."""
    clipped = target.image >= 1
    return clipped if target.silhouette is None else clipped & (target.silhouette[..., None] > 0)


def is_async(device: torch.device) -> bool:
    """Whether the host would wait to look at a tensor there."""
    return device.type != "cpu"


def check_losses(stage: Stage, iteration: int, losses: Mapping[str, float | Tensor]) -> dict[str, float]:
    """Return the losses as numbers.

    Raises
    ------
    DivergedError
        If their sum is not finite.
    """
    values = {kind: float(value) for kind, value in losses.items()}
    if not math.isfinite(sum(values.values())):
        raise diverged(stage, iteration, f"the loss ({', '.join(f'{k} {v:g}' for k, v in values.items())})")
    return values


def learning_rows(state: TrainState, stage: Stage) -> Tensor | None:
    """Return the splats [N] of which the stage trains anything; None where it trains an attribute of all."""
    groups = set(stage.train.values())
    if not groups or "all" in groups:
        return None
    return torch.stack([state.groups[group] for group in sorted(groups)]).any(dim=0)


def diverged(stage: Stage, iteration: int, what: str) -> DivergedError:
    """Return the error for something that is not finite."""
    return DivergedError(
        f"training diverged at iteration {iteration} of stage {stage.name!r}: {what} is NaN or infinite; "
        f"lower a rate (--set {stage.name}.lr.means=...) or check the cameras and photographs"
    )


def _gradient(leaf: Tensor) -> Tensor:
    """Return the gradient of a leaf; zero where nothing depends on it."""
    return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad


def first_not_finite(tensors: Mapping[str, Tensor], backend: Backend) -> str | None:
    """Return the name of the first tensor that holds a NaN or an infinity; None if all are finite."""
    number = backend.first_not_finite(list(tensors.values()))
    return None if number is None else list(tensors)[number]
