"""Robust training, as the training loop meets it: where to start, which floaters to remove, how opacity decays."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from gs2d.config.protocols import BLACK
from gs2d.config.recipe import Recipe, Stage
from gs2d.config.robust import DenseStart, Removal
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene
from gs2d.errors import DataError
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from gs2d.training import events
from gs2d.training.backdrop import in_color
from gs2d.training.background_sphere import sphere_points
from gs2d.training.free_space import FreeSpaceMaps
from gs2d.training.initialize import Initial
from gs2d.training.learned.appearance import shown
from gs2d.training.learned.learned_table import LearnedTable
from gs2d.training.learned.quantity import ImagePoints
from gs2d.training.opaque import is_opaque
from gs2d.training.parallel import ONE_PROCESS, OneProcess
from gs2d.training.plane_sweep import SmallView, Sweep, start_points, sweep_views
from gs2d.training.rows import keep_rows
from gs2d.training.seen_area import largest_log_scales, mostly_unseen
from gs2d.training.start_fit import fit_start
from gs2d.training.state import TrainState
from gs2d.training.trial import Witness, missed

PARTS = 5  # of a stage: at the end of each, all splats are proposed and tried anew, also those that were missed before
FEW_NEW = 0.002  # of the splats: fewer new proposals wait, because a trial costs as much as some 50 iterations
SHOWN = 0.25  # of the images, and 3 at least, that show a surface where splats are kept small
MAX_WITNESSES = 24  # images that a trial asks; of more images each trial asks others
DECAY_EVERY, LEAST_OPACITY = 10, 0.005  # iterations; splats never decay below what is pruned or not drawn
NEEDED, REMOVED = 1, 2  # verdicts; 0: not tried
MISSED = "missed"  # the row group of splats that a trial has found to be needed


def check_free_space(scene: Scene, recipe: Recipe) -> None:
    """Raise DataError where floaters are to be removed, and no sparse points say where space is free."""
    if recipe.removal is not None and scene.observed() is None:
        raise DataError(
            f"{scene.name} must say which sparse points its photographs show (COLMAP does) for free space; "
            f"train with --robust off ({scene.unobserved()})"
        )


class Robustness:
    """The dense start, the removal of floaters and the opacity decay of a recipe on a scene, where it has them.

    Parameters
    ----------
    scene : Scene
    recipe : Recipe
    raster : RasterSettings
        Of training.
    backend : Backend
        Renders what is tried.
    processes : OneProcess
        Those that train together. Process 0 makes the start and tries removals for all.
    frozen : Splats, optional
        Splats that photographs show too, and that stay.

    Attributes
    ----------
    scene : Scene
        With the points that training starts from.
    lacks : str
        Why there is no dense start where the recipe has one that is not required; empty where there is one.

    Raises
    ------
    DataError
        From the constructor: floaters are to be removed, and the capture has no sparse points that its images show; or
        a plane sweep finds nothing to start from, and the recipe requires that.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        raster: RasterSettings,
        backend: Backend,
        processes: OneProcess = ONE_PROCESS,
        frozen: Splats | None = None,
    ) -> None:
        self._processes, self._frozen = processes, frozen
        self.scene, self._learned, self._recipe = scene, LearnedTable(recipe, scene), recipe
        self._raster, self._backend = raster, backend
        self._free: FreeSpaceMaps | None = None
        self._images: Sequence[SmallView] = ()
        self._sweep: Sweep | None = None  # until the first splats are fitted
        self.lacks = ""
        if (recipe.dense_start is None and recipe.removal is None) or not processes.leads:
            return
        check_free_space(scene, recipe)
        start = recipe.dense_start
        try:
            sweep = sweep_views(scene, start or DenseStart())
            if start is not None:
                # Large splats do harm unless those that hide something are removed.
                around = sphere_points(scene, sweep, start.sphere) if start.sphere and is_opaque(recipe) else None
                self.scene = replace(scene, points=start_points(scene, sweep, start, around))
        except DataError as error:
            if start is None or start.required or recipe.removal is not None:
                raise
            self.lacks = str(error).partition("; ")[0]  # without what to do about it
            return
        self._sweep = None if start is None or start.fit is None else sweep
        if recipe.removal is not None:
            self._free = FreeSpaceMaps(sweep, spilled=scene.ahead > 0)
            self._images = sweep.views

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

    def removes(self, stage: Stage, iteration: int) -> bool:
        """Whether splats may be removed at the end of an iteration (1-based) of a stage."""
        return looks_at_free_space(self._recipe, stage, iteration) or ends_part(self._recipe, stage, iteration)

    def remove(self, state: TrainState, stage: Stage, iteration: int) -> list[events.TrainingEvent]:
        """Shrink splats that are too large for a known surface and remove floaters, where that is due."""
        if not self.removes(stage, iteration):
            return []
        if iteration < stage.iterations:  # what is left out is learned by others, which takes iterations
            self._limit_scales(state)
        nobody = torch.zeros(state.splats.means.shape[0], dtype=torch.bool, device=state.splats.device)
        known = nobody if ends_part(self._recipe, stage, iteration) else state.groups.get(MISSED, nobody)
        verdict = self._processes.decide(
            lambda splats, spared: self._tried(state, stage, iteration, splats, spared), state.splats, known
        )
        guilty = verdict == REMOVED
        state.groups[MISSED] = known | (verdict == NEEDED)
        removed = int(guilty.sum())
        if removed == 0 or removed == len(state.splats):  # all: the images contradict each other
            return []
        keep_rows(state, ~guilty)
        return [events.FloatersRemoved(stage.name, iteration, removed, len(state.splats))]

    @torch.no_grad()
    def _limit_scales(self, state: TrainState) -> None:
        """Shrink large splats on surfaces of known depth, which are sheets and needles before the detail of a wall.

        Elsewhere large splats stay: they are all that new views show where few images look.
        """
        cameras = [view.camera for view in self._learned.scene_now(state.learned).train]
        most = largest_log_scales(state.splats, cameras)
        large = (state.splats.log_scales > most).any(dim=1)
        shrinks = self._processes.decide(self._are_shown, state.splats, large).bool()
        scales = state.splats.log_scales
        self._backend.assign(scales, torch.where(shrinks[:, None], torch.minimum(scales, most), scales))

    def _are_shown(self, splats: Splats, large: Tensor) -> Tensor:
        """Return which of the large splats lie on a surface that many images show, uint8 [N]."""
        assert self._free is not None
        result = torch.zeros(len(splats), dtype=torch.uint8, device=splats.device)
        rows = large.nonzero().squeeze(1)
        result[rows] = (self._free.showing(splats.rows(rows)) >= max(3, SHOWN * len(self._images))).byte()
        return result

    def _tried(self, state: TrainState, stage: Stage, iteration: int, splats: Splats, spared: Tensor) -> Tensor:
        """Propose splats, but those that are spared, and try them: NEEDED, REMOVED or neither, uint8 [N]."""
        last = ends_part(self._recipe, stage, iteration)
        against = self._proposed(state, splats, last=last).masked_fill(spared, 0)
        verdict = torch.zeros(len(splats), dtype=torch.uint8, device=splats.device)
        proposed = against > 0
        if not proposed.any() or (not last and int(proposed.sum()) < FEW_NEW * len(splats)):
            return verdict
        # Over black: what has the colour of the background is missed too, unless that is unlit and nothing is there.
        raster = self._raster if self._removal.backdrop else replace(self._raster, background=BLACK)
        step = max(1, -(-len(self._images) // MAX_WITNESSES))
        rows = range(iteration // self._removal.every % step, len(self._images), step)
        whole = splats if self._frozen is None else splats.followed_by(self._frozen)
        needed = missed(
            whole,
            torch.cat([against, against.new_zeros(len(whole) - len(splats))]),
            self._witnesses(state, rows),
            raster,
            self._backend,
            stands_for=len(self._images) / len(rows),
        )[: len(splats)]
        verdict[proposed] = REMOVED
        verdict[needed] = NEEDED
        return verdict

    @property
    def _removal(self) -> Removal:
        assert self._recipe.removal is not None
        return self._recipe.removal

    def _proposed(self, state: TrainState, splats: Splats, *, last: bool) -> Tensor:
        """Return how many images speak against each splat, int32 [N]."""
        assert self._free is not None
        against = self._free.against(splats)
        if last:
            cameras = [view.camera for view in self._learned.scene_now(state.learned).train]
            against = against.maximum(mostly_unseen(splats, cameras, self._raster, self._backend).to(against))
        if self._removal.backdrop:
            against = against.maximum(in_color(splats, self._raster.background).to(against))
        return against

    def _witnesses(self, state: TrainState, rows: range) -> Iterator[Witness]:
        views = self._learned.scene_now(state.learned).train
        for row in rows:
            image, device = self._images[row], state.splats.device
            height, width = image.size
            (fx, _, cx), (_, fy, cy), _ = image.K.tolist()
            camera = Camera(width, height, fx, fy, cx, cy, views[row].camera.T_cam_world)
            color = image.color.permute(1, 2, 0).to(device)
            numbers = self._learned.numbers(state.learned, row, color)
            photographed = partial(shown, numbers=numbers, at=ImagePoints(camera))
            yield Witness(camera, color, torch.from_numpy(image.usable).to(device), photographed)

    @torch.no_grad()
    def decay(self, state: TrainState, stage: Stage, iteration: int, backend: Backend) -> None:
        """Let opacity decay, where that is due, but of splats in the colour of the background.

        Over that background no image would ask for them again.
        """
        removal = self._recipe.removal
        if removal is None or removal.decay == 0 or stage.train.get("opacity_logits") != "all":
            return
        if iteration % DECAY_EVERY:
            return
        logits = state.splats.opacity_logits
        least = math.log(LEAST_OPACITY / (1 - LEAST_OPACITY))
        faded = torch.logit(torch.sigmoid(logits) * (1 - removal.decay)).clamp_min(least)
        fades = ~in_color(state.splats, self._raster.background).reshape(logits.shape) & (logits > least)
        backend.assign(logits, torch.where(fades, faded, logits))


def looks_at_free_space(recipe: Recipe, stage: Stage, iteration: int) -> bool:
    """Whether splats in free space are proposed for removal at the end of an iteration (1-based) of a stage."""
    return recipe.removal is not None and stage.moves_all and iteration % recipe.removal.every == 0


def ends_part(recipe: Recipe, stage: Stage, iteration: int) -> bool:
    """Whether a fifth of a stage ends with an iteration (1-based), after which all splats are tried anew."""
    if recipe.removal is None or not stage.moves_all:
        return False
    return iteration * PARTS // stage.iterations > (iteration - 1) * PARTS // stage.iterations
