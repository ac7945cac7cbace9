"""Robust training: the dense start, the removal of floaters and the decay of opacity."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from gs2d.config.protocols import BLACK
from gs2d.config.recipe import DenseStart, Recipe, Removal, Stage
from gs2d.core.camera import Camera
from gs2d.core.image_arrays import enlarged
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene
from gs2d.errors import DataError
from gs2d.kernels.library import optional_library
from gs2d.meshing.warped_ncc import GreyImage
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from gs2d.training import events
from gs2d.training.learned.learned_table import LearnedTable, shown
from gs2d.training.learned.quantity import ImagePoints
from gs2d.training.parallel import ONE_PROCESS, ProcessGroup
from gs2d.training.robust import shine, transients
from gs2d.training.robust.backdrop import in_color
from gs2d.training.robust.free_space_maps import FreeSpaceMaps
from gs2d.training.robust.large_splats import LARGEST, LARGEST_ANYWHERE, largest_log_scales, votes_against_unseen
from gs2d.training.robust.regularise import is_opaque
from gs2d.training.robust.trial import Witness, missed
from gs2d.training.robust.view_cells import ViewCells
from gs2d.training.rows import keep_rows
from gs2d.training.start.background_sphere import sphere_points
from gs2d.training.start.camera_adjustment import adjust_cameras
from gs2d.training.start.initialize import initial_splats, splats_as_start
from gs2d.training.start.plane_sweep import SmallView, Sweep, sweep_views
from gs2d.training.start.prior_points import with_prior_points
from gs2d.training.start.start_fit import fit_start
from gs2d.training.start.start_points import start_points
from gs2d.training.state import TrainState

MIN_START = 10  # a dense start with fewer splats gives way to the splats of ``init``
PARTS = 5  # of a stage: at the end of each, all proposed splats are tried again, also those that were missed before
FEW_NEW = 0.002  # fraction of the splats: fewer new proposals wait, because a trial costs about 50 iterations
SHOWN = 0.25  # fraction of the images, and at least 3, that must show a surface on which splats are kept small
LIMITED_FROM = 0.4  # of a stage: before, training goes from coarse to fine, and shrinking costs up to 1.2 dB
MAX_WITNESSES = 24  # images of a trial; with more images, each trial uses others
COMPARED = (0.3, 0.5, 0.7)  # fractions of a stage after which images are compared: the surface must be there
DECAY_EVERY, LEAST_OPACITY = 10, 0.005  # iterations between decays; opacity that decay does not go below
NEEDED, REMOVED = 1, 2  # verdicts; 0: not tried
MISSED = "missed"  # row group of the splats that a trial found to be needed


def check_free_space(scene: Scene, recipe: Recipe) -> None:
    """Raise DataError if the recipe removes floaters, but the scene has no sparse points to determine free space."""
    if recipe.removal is not None and scene.observed() is None:
        raise DataError(
            f"{scene.name} must have sparse points and the images that show them to remove floaters (COLMAP has both), "
            f"got {scene.unobserved()}; train with --robust off"
        )


def with_adjusted_cameras(
    scene: Scene, start: DenseStart | None, processes: ProcessGroup
) -> tuple[Scene, Sweep | None]:
    """Return the scene with the cameras that process 0 adjusts, if the start does that, and its sweep in process 0."""
    if start is None or not start.adjust:
        return scene, None
    adjusted, sweep = adjust_cameras(scene, start) if processes.leads else (scene, None)
    poses = torch.from_numpy(np.stack([view.camera.T_cam_world for view in adjusted.train]).astype(np.float64))
    decided = processes.decide(lambda: poses, poses, torch.float64).numpy()
    if processes.leads:
        return adjusted, sweep
    return scene.with_poses({view.name: pose for view, pose in zip(scene.train, decided, strict=True)}), None


class Robustness:
    """Dense start, removal of floaters and opacity decay of a recipe on a scene, as far as the recipe has them.

    ``raster``: rasterizer settings of training. ``backend``: renders the trials. ``processes``: processes that train
    together. Process 0 makes the start and the trials for all. ``frozen``: further splats of the scene, which are not
    trained. ``sweep``: plane sweep of the scene with the settings of the recipe, if it is there already.

    The constructor raises DataError if floaters are to be removed and the capture does not list sparse points and their
    images, or if a required dense start finds nothing. ``scene`` has the points that training starts from;
    ``start_failure`` is the reason if an optional dense start failed, else empty.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        raster: RasterSettings,
        backend: Backend,
        processes: ProcessGroup = ONE_PROCESS,
        frozen: Splats | None = None,
        sweep: Sweep | None = None,
    ) -> None:
        self._processes, self._frozen = processes, frozen
        self.scene, self._learned, self._recipe = scene, LearnedTable(recipe, scene), recipe
        self._raster, self._backend = raster, backend
        self._free: FreeSpaceMaps | None = None
        self._images: Sequence[SmallView] = ()
        self._neighbours: Sequence[Sequence[int]] = ()
        self._sweep: Sweep | None = None  # kept until the first splats are fitted
        self.start_failure = ""
        if (recipe.dense_start is None and recipe.removal is None) or not processes.leads:
            return
        check_free_space(scene, recipe)
        start = recipe.dense_start
        try:
            sweep = sweep or sweep_views(scene, start or DenseStart())
            if start is not None:
                # The large splats of a sphere need the removal of those that hide something.
                around = sphere_points(scene, sweep) if start.sphere and is_opaque(recipe) else None
                self.scene = replace(scene, points=start_points(scene, sweep, start, around))
        except DataError as error:
            if start is None or start.required or recipe.removal is not None:
                raise
            self.start_failure = str(error).partition("; ")[0]  # without the advice
            return
        self._sweep = sweep if start is not None and start.fit else None
        if recipe.removal is not None:
            self._free = FreeSpaceMaps(sweep, spilled=scene.ahead > 0)
            self._images, self._neighbours = sweep.views, sweep.neighbours

    def first_splats(
        self,
        near: float,
        generator: torch.Generator,
        dtype: torch.dtype,
        init: Splats | None = None,
        within: Callable[[Tensor], Tensor] | None = None,
    ) -> tuple[Splats, events.Initialised]:
        """Return the splats that training starts from, and the event that reports them. Frees the sweep.

        ``near`` (world units): points nearer to a camera are dropped. ``init``: splats to start from, unless a dense
        start finds enough others. ``within``: returns which points [M, 3] belong to the trained part of the scene, [M]
        bool.
        """
        recipe, dense = self._recipe, self._recipe.dense_start is not None and not self.start_failure
        if init is None or dense:
            start = with_prior_points(self.scene, recipe)
            initial = initial_splats(
                start,
                sh_degree=recipe.sh_degree,
                random_points=recipe.init_points,
                near=near,
                generator=generator,
                dtype=dtype,
            )
            source = initial.source if start is self.scene else "depths"
            source = "sweep" if source == "points" and dense else source
            sweep, self._sweep = self._sweep, None
            splats = initial.splats if sweep is None else fit_start(initial.splats, sweep, initial.sized)
            splats = splats if within is None else splats.rows(within(splats.means))
            if init is None or len(splats) >= MIN_START:
                return splats, events.Initialised(len(splats), source, initial.dropped, self.start_failure)
        splats = splats_as_start(init, sh_degree=recipe.sh_degree, dtype=dtype)
        return splats, events.Initialised(len(splats), "splats", 0)

    def move_to(self, device: torch.device | str) -> None:
        """Move all tensors to a device."""
        if self._free is not None:
            self._free.move_to(device)

    def acts(self, stage: Stage, iteration: int) -> bool:
        """Return whether the state may change at the end of an iteration (1-based) of a stage, besides decay."""
        return self.removes(stage, iteration) or self._compares(stage, iteration)

    def removes(self, stage: Stage, iteration: int) -> bool:
        """Return whether splats may be removed at the end of an iteration (1-based) of a stage."""
        removal = self._recipe.removal
        if removal is None or not stage.moves_all:
            return False
        return iteration % removal.every == 0 or _ends_part(stage, iteration)

    def remove(self, state: TrainState, stage: Stage, iteration: int) -> list[events.TrainingEvent]:
        """Shrink splats that are too large for a known surface and remove floaters, if due."""
        if not self.removes(stage, iteration):
            return []
        # After shrinking, other splats must still learn to cover what it uncovers.
        if LIMITED_FROM * stage.iterations <= iteration < stage.iterations:
            self._limit_scales(state)
        nobody = torch.zeros(state.splats.means.shape[0], dtype=torch.bool, device=state.splats.device)
        spared = nobody if _ends_part(stage, iteration) else state.groups.get(MISSED, nobody)
        verdict = self._processes.decide(lambda: self._tried(state, stage, iteration, spared), spared)
        floaters = verdict == REMOVED
        state.groups[MISSED] = spared | (verdict == NEEDED)
        removed = int(floaters.sum())
        if removed == 0 or removed == len(state.splats):  # all: the images contradict each other
            return []
        keep_rows(state, ~floaters)
        return [events.FloatersRemoved(stage.name, iteration, removed, len(state.splats))]

    @torch.no_grad()
    def _limit_scales(self, state: TrainState) -> None:
        """Shrink large splats on surfaces of known depth, where they hide detail, and all larger than an image.

        Elsewhere large splats stay, because they are all that new views show in regions with few images. Beyond the
        size of an image, the tail of a splat is a veil before the surface.
        """
        cameras = [view.camera for view in self._learned.scene_now(state.learned).train]
        most = largest_log_scales(state.splats, cameras)
        large = (state.splats.log_scales > most).any(dim=1)
        shrinks = self._processes.decide(lambda: self._are_shown(state.splats, large), large).bool()
        scales = state.splats.log_scales
        limits = torch.where(shrinks[:, None], most, most + math.log(LARGEST_ANYWHERE / LARGEST))
        self._backend.assign(scales, torch.minimum(scales, limits))

    def compare(self, state: TrainState, stage: Stage, iteration: int, *, shiny: bool) -> bool:
        """Compare the images with one another, if due, and return whether other pixels count from now on.

        Detects what single images show and, with ``shiny``, shiny surface; without the native library all is matt.
        """
        if not self._compares(stage, iteration):
            return False
        before = state.maps.get("transient")

        def decided(cells: int, find: Callable[[TrainState, Tensor], Tensor]) -> Tensor:
            nothing = torch.zeros((len(self.scene.train), cells, cells), dtype=torch.uint8)
            on_device = nothing.to(state.splats.device)
            return self._processes.decide(lambda: find(state, nothing).to(on_device.device), on_device)

        if len(self.scene.train) > transients.SHOWING:
            state.maps["transient"] = decided(transients.CELLS, self._transients)
        if shiny:
            state.maps["shine"] = decided(shine.CELLS, self._shine)
        now = state.maps.get("transient")
        return now is not None and bool(now.any() if before is None else (now != before).any())

    def _compares(self, stage: Stage, iteration: int) -> bool:
        due = {round(part * stage.iterations) for part in COMPARED}
        return self._recipe.removal is not None and stage.moves_all and iteration in due

    @torch.no_grad()
    def _rendered(self, state: TrainState, row: int) -> tuple[Camera, Tensor, np.ndarray]:
        """Return camera, colours as photographed [H, W, 3] and depth [H, W] (0: no surface) of a downscaled image."""
        camera, settings = self._camera(state, row), self._raster.for_depths("transmittance")
        output = rasterize(self._whole(state.splats), camera, settings, backend=self._backend)
        numbers = self._learned.numbers(state.learned, row, output.color)
        depth = torch.where(output.alpha > 0.5, output.depth("transmittance"), 0.0)
        return camera, shown(output.color, numbers, ImagePoints(camera)), depth.cpu().numpy()

    def _transients(self, state: TrainState, nothing: Tensor) -> Tensor:
        def compared(row: int) -> ViewCells:
            image, (camera, color, depth) = self._images[row], self._rendered(state, row)
            difference = image.color.permute(1, 2, 0) - color.cpu()
            return transients.differences(camera, difference, depth, image.usable)

        return transients.transient_maps(map(compared, range(len(nothing))))

    def _shine(self, state: TrainState, matt: Tensor) -> Tensor:
        library = optional_library()
        if library is None:
            return matt

        def rendered(row: int) -> tuple[GreyImage, np.ndarray]:
            camera, _, depth = self._rendered(state, row)
            return GreyImage(camera, self._images[row].grey[0, 0].numpy(), self._usable(state, row)), depth

        return shine.shine_maps(rendered, self._neighbours, library)

    def _usable(self, state: TrainState, row: int) -> np.ndarray:
        """Return the pixels of a downscaled image that count, bool [H, W]."""
        usable, maps = self._images[row].usable, state.maps.get("transient")
        return usable if maps is None else usable & (enlarged(maps[row].cpu().numpy(), *usable.shape) == 0)

    def _are_shown(self, splats: Splats, large: Tensor) -> Tensor:
        """Return which of the large splats lie on a surface that many images show, uint8 [N]."""
        assert self._free is not None
        result = torch.zeros(len(splats), dtype=torch.uint8, device=splats.device)
        rows = large.nonzero().squeeze(1)
        result[rows] = (self._free.showing(splats.rows(rows)) >= max(3, SHOWN * len(self._images))).byte()
        return result

    def _tried(self, state: TrainState, stage: Stage, iteration: int, spared: Tensor) -> Tensor:
        """Propose splats that are not spared [N], and try them: NEEDED, REMOVED or 0, uint8 [N]."""
        splats = state.splats
        last = _ends_part(stage, iteration)
        against = self._proposed(state, splats, last=last).masked_fill(spared, 0)
        verdict = torch.zeros(len(splats), dtype=torch.uint8, device=splats.device)
        proposed = against > 0
        if not proposed.any() or (not last and int(proposed.sum()) < FEW_NEW * len(splats)):
            return verdict
        # Over black, splats in the colour of the background are missed, too, unless that is an unlit backdrop.
        raster = self._raster if self._removal.backdrop else replace(self._raster, background=BLACK)
        step = max(1, -(-len(self._images) // MAX_WITNESSES))
        rows = range(iteration // self._removal.every % step, len(self._images), step)
        whole = self._whole(splats)
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

    def _whole(self, splats: Splats) -> Splats:
        """Return the splats, followed by the frozen ones."""
        return splats if self._frozen is None else splats.followed_by(self._frozen)

    @property
    def _removal(self) -> Removal:
        assert self._recipe.removal is not None
        return self._recipe.removal

    def _proposed(self, state: TrainState, splats: Splats, *, last: bool) -> Tensor:
        """Return the number of images that speak against each splat, int32 [N]."""
        assert self._free is not None
        against = self._free.against(splats)
        if last:
            cameras = [view.camera for view in self._learned.scene_now(state.learned).train]
            against = against.maximum(votes_against_unseen(splats, cameras, self._raster, self._backend))
        if self._removal.backdrop:
            against = against.maximum(in_color(splats, self._raster.background).to(against))
        return against

    def _witnesses(self, state: TrainState, rows: range) -> Iterator[Witness]:
        for row in rows:
            image, device = self._images[row], state.splats.device
            camera = self._camera(state, row)
            color = image.color.permute(1, 2, 0).to(device)
            numbers = self._learned.numbers(state.learned, row, color)
            photographed = partial(shown, numbers=numbers, at=ImagePoints(camera))
            yield Witness(camera, color, torch.from_numpy(self._usable(state, row)).to(device), photographed)

    def _camera(self, state: TrainState, row: int) -> Camera:
        """Return the current camera of a downscaled image."""
        image = self._images[row]
        height, width = image.size
        (fx, _, cx), (_, fy, cy), _ = image.K.tolist()
        now = self._learned.camera(state.learned, row, self.scene.train[row].camera, ())
        return Camera(width, height, fx, fy, cx, cy, now.T_cam_world)

    @torch.no_grad()
    def decay(self, state: TrainState, stage: Stage, iteration: int, backend: Backend) -> None:
        """Let opacity decay, if due, except for splats in the colour of the background.

        Over that background, their loss would change no image.
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


def _ends_part(stage: Stage, iteration: int) -> bool:
    """Return whether one of ``PARTS`` of a stage ends with an iteration (1-based)."""
    return iteration * PARTS // stage.iterations > (iteration - 1) * PARTS // stage.iterations
