"""What keeps fog out of a scene, as the training loop meets it: where to start, what to prune, how opacity decays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from gs2d.config.recipe import Recipe, Stage
from gs2d.config.robust import DenseStart, SeenArea
from gs2d.core.sh import C0, rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene
from gs2d.errors import DataError
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from gs2d.training import events, per_image
from gs2d.training.background_sphere import sphere_points
from gs2d.training.free_space import FreeSpaceMaps
from gs2d.training.initialize import Initial
from gs2d.training.parallel import ONE_PROCESS, OneProcess
from gs2d.training.plane_sweep import Sweep, start_points, sweep_views
from gs2d.training.rows import keep_rows
from gs2d.training.seen_area import mostly_unseen
from gs2d.training.start_fit import fit_start
from gs2d.training.state import TrainState


def check_free_space(scene: Scene, recipe: Recipe) -> None:
    """Raise DataError where free space is to be kept, and no sparse points say where it is."""
    if recipe.free_space is not None and scene.observed() is None:
        raise DataError(
            f"{scene.name} must say which sparse points its photographs show (COLMAP does) for free space; "
            f"train with --robust off ({scene.unobserved()})"
        )


class Robustness:
    """The dense start, pruning and opacity decay of a recipe on a scene; nothing where it has none of them.

    Parameters
    ----------
    scene : Scene
    recipe : Recipe
    raster : RasterSettings
        Of training, and ``backend`` that renders: to see how much of a splat is photographed.
    backend : Backend
    processes : OneProcess
        Those that train together. Process 0 makes the start, and looks at free space and seen area for all.

    Attributes
    ----------
    scene : Scene
        With the points that training starts from.
    lacks : str
        Why there is no dense start where the recipe has one that is not required; empty where there is one.

    Raises
    ------
    DataError
        From the constructor: free space is to be kept, and the capture has no sparse points that its photographs show;
        or a plane sweep finds nothing to start from, and the recipe requires that.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        raster: RasterSettings,
        backend: Backend,
        processes: OneProcess = ONE_PROCESS,
    ) -> None:
        self._processes = processes
        self.scene, self._given, self._recipe = scene, scene, recipe
        self._raster, self._backend = raster, backend
        self._free: FreeSpaceMaps | None = None
        self._sweep: Sweep | None = None  # until the first splats are fitted
        self.lacks = ""
        if (recipe.dense_start is None and recipe.free_space is None) or not processes.leads:
            return
        check_free_space(scene, recipe)
        start = recipe.dense_start
        try:
            sweep = sweep_views(scene, start or DenseStart())
            if start is not None:
                around = None if start.sphere is None else sphere_points(scene, sweep, start.sphere)
                self.scene = replace(scene, points=start_points(scene, sweep, start, around))
        except DataError as error:
            if start is None or start.required or recipe.free_space is not None:
                raise
            self.lacks = str(error).partition("; ")[0]  # without what to do about it
            return
        self._sweep = None if start is None or start.fit is None else sweep
        if recipe.free_space is not None:
            self._free = FreeSpaceMaps(sweep, recipe.free_space, spilled=scene.ahead > 0)

    @property
    def starts_densely(self) -> bool:
        """Whether training starts where photographs agree."""
        return self._recipe.dense_start is not None and not self.lacks

    def fitted(self, first: Initial) -> Splats:
        """Return the first splats as the dense start has them fitted; themselves where it fits none. Once."""
        settings, sweep, self._sweep = self._recipe.dense_start, self._sweep, None
        if settings is None or sweep is None:
            return first.splats
        return fit_start(first.splats, sweep, settings, first.sized)

    def move_to(self, device: torch.device | str) -> None:
        """Move all tensors to a device."""
        if self._free is not None:
            self._free.move_to(device)

    def prunes(self, stage: Stage, iteration: int) -> bool:
        """Whether splats may be pruned at the end of an iteration (1-based) of a stage."""
        return looks_at_free_space(self._recipe, stage, iteration) or looks_at_seen_area(self._recipe, stage, iteration)

    def prune(self, state: TrainState, stage: Stage, iteration: int) -> list[events.Event]:
        """Prune the splats in free space, and those of which little is photographed, where that is due."""
        happened: list[events.Event] = []
        if looks_at_free_space(self._recipe, stage, iteration):
            pruned = self._drop(state, self._in_free_space)
            if pruned:
                happened.append(events.FreeSpacePruned(stage.name, iteration, pruned, state.count))
        settings = self._recipe.seen_area
        if settings is not None and looks_at_seen_area(self._recipe, stage, iteration):
            pruned = self._drop(state, partial(self._unseen, state, settings))
            if pruned:
                happened.append(events.UnseenPruned(stage.name, iteration, pruned, state.count))
        return happened

    def _in_free_space(self, splats: Splats) -> Tensor:
        assert self._free is not None
        return self._free.inside(splats)

    def _unseen(self, state: TrainState, settings: SeenArea, splats: Splats) -> Tensor:
        cameras = [view.camera for view in per_image.scene_now(state, self._given).train]
        return mostly_unseen(splats, cameras, settings, self._raster, self._backend)

    def _drop(self, state: TrainState, mask: Callable[[Splats], Tensor]) -> int:
        """Drop the splats of a mask [N] and return how many: none where nothing would be left."""
        found = self._processes.decide(mask, state.splats)
        dropped = state.parts.count(int(found.sum()))
        if dropped == 0 or dropped == state.count:  # all: the photographs contradict each other
            return 0
        keep_rows(state, ~found)
        return dropped

    def _like_backdrop(self, splats: Splats, within: float) -> Tensor:
        """Find the splats [N] of the colour that is drawn where there is none."""
        backdrop = rgb_to_sh0(splats.sh0.new_tensor([self._raster.background]))
        return (splats.sh0 - backdrop).abs().amax(dim=(1, 2)) <= within / C0

    @torch.no_grad()
    def decay(self, state: TrainState, stage: Stage, iteration: int, backend: Backend) -> None:
        """Let opacity decay, where that is due."""
        settings = self._recipe.opacity_decay
        if settings is None or stage.train.get("opacity_logits") != "all" or iteration % settings.every:
            return
        logits = state.splats.opacity_logits
        least = math.log(settings.least / (1 - settings.least))
        kept: Tensor | float = 1 - settings.rate
        if settings.backdrop_rate is not None:
            like = self._like_backdrop(state.splats, settings.backdrop_within)
            kept = torch.where(like, 1 - settings.backdrop_rate, kept).reshape(logits.shape)
        faded = torch.logit(torch.sigmoid(logits) * kept).clamp_min(least)
        backend.assign(logits, torch.where(logits > least, faded, logits))


def looks_at_free_space(recipe: Recipe, stage: Stage, iteration: int) -> bool:
    """Whether splats are pruned from free space at the end of an iteration (1-based) of a stage."""
    settings = recipe.free_space
    return settings is not None and stage.moves_all and iteration % settings.every == 0


def looks_at_seen_area(recipe: Recipe, stage: Stage, iteration: int) -> bool:
    """Whether splats of which little is photographed are pruned at the end of an iteration (1-based) of a stage."""
    settings = recipe.seen_area
    if settings is None or not stage.moves_all:
        return False
    return iteration * settings.times // stage.iterations > (iteration - 1) * settings.times // stage.iterations
