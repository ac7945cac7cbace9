"""The training loop: stages in order, each iteration in the order of the official 2DGS code.

An iteration computes loss and gradients, gathers statistics, densifies and prunes, resets opacity, and takes an Adam
step. An iteration that densifies updates nothing, because its rows are new; one that resets opacity updates all other
attributes. The loop prints nothing and knows no paths; it sends events.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from gs2d.config.actions import ACTIONS
from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe, Stage, validate
from gs2d.core.memory import trim
from gs2d.core.splats import Splats
from gs2d.data.cache import ReadAhead
from gs2d.data.scene import Scene
from gs2d.errors import DataError, RecipeError, RunError
from gs2d.losses.base import losses_of
from gs2d.render.backends import Backend, get_backend
from gs2d.render.types import RasterSettings
from gs2d.training import events
from gs2d.training.actions.entry_action import EntryAction, StageEntry
from gs2d.training.cached_objective import CachedViews, choose_objective
from gs2d.training.densify.densifier import Densifier, Surroundings, densifier_of
from gs2d.training.learned.learned_table import LearnedTable, first_not_finite_quantity
from gs2d.training.objective import (
    FullRender,
    check_losses,
    diverged,
    first_not_finite,
    no_view,
    raster_settings,
    visible_mask,
)
from gs2d.training.optimizer import adam_step, begin_stage, lr_at
from gs2d.training.parallel import ONE_PROCESS, ProcessGroup, Turn
from gs2d.training.photographs import TrainedViews, needs_faces
from gs2d.training.resumable import check_resumable
from gs2d.training.robust.regularise import is_opaque
from gs2d.training.robust.robustness import Robustness, with_adjusted_cameras
from gs2d.training.robust.transients import with_maps
from gs2d.training.rows import keep_rows
from gs2d.training.state import TrainState
from gs2d.training.step_result import StepResult
from gs2d.training.targets import TargetSource, is_async, make_targets
from gs2d.training.whole_steps import WholeSteps

__all__ = ["OnEvent", "Trainer", "TrainerOptions", "raster_settings"]

OnEvent = Callable[[events.TrainingEvent], None]


@dataclass(frozen=True, eq=False)
class TrainerOptions:
    """Further inputs and memory limits of a training.

    Attributes
    ----------
    between : callable
        Called after each iteration on the CPU, for other work that uses the rasterizer. It must not change the state.
    frozen : Splats or None
        Splats around the trained part of a scene, of the recipe's SH degree. They are rendered with the trained splats,
        and never changed, counted, densified or returned.
    within : callable or None
        Returns which points [M, 3] belong to the trained part, [M] bool. With ``init`` and a dense start: training
        starts from the swept points in that part, and from ``init`` only if there are almost none.
    exposures : Tensor [V, 3, 4] or None
        Transforms of the training views, for a recipe with fixed exposures.
    progress_every : int
        Iterations between Progress events. The last iteration of a stage always sends one.
    stage2_cache_bytes : int
        Memory for cached views (cpu backend, stages that train only the colours of a row group); 0 = none. The first
        views that fit are cached. The result depends on it by rounding.
    dtype : torch.dtype
        Type of new splats.
    processes : ProcessGroup
        Processes that train together (``training.parallel.ProcessGroup``), each with its own Trainer of the same scene
        and recipe. An iteration of W processes takes W views and counts as W iterations: ``state.step`` counts views.
        Process 0 provides ``state``, ``init`` or the start for all.
    """

    between: Callable[[], None] = lambda: None
    frozen: Splats | None = None
    within: Callable[[Tensor], Tensor] | None = None
    exposures: Tensor | None = None
    progress_every: int = 10
    stage2_cache_bytes: int = 1 << 30
    dtype: torch.dtype = torch.float32
    processes: ProcessGroup = ONE_PROCESS


class Trainer:
    """Train the splats of a scene by a recipe under a protocol.

    Parameters
    ----------
    scene : Scene
    recipe : Recipe
    protocol : Protocol
    backend : str or Backend
        Rasterizer: "auto", "cuda", "cpu" or "reference". Its device holds all tensors.
    on_event : callable
        Receives every event. The state is consistent then, so ``state.state_dict()`` may be saved. An exception that it
        raises stops the training.
    state : TrainState, optional
        State to continue from. Without it, training starts from ``recipe.seed``.
    init : Splats, optional
        Splats to start from instead of points; copied to the recipe's SH degree.
    options : TrainerOptions

    Raises
    ------
    RecipeError, DataError, ProtocolError, BackendError, RunError
        From the constructor, before anything is trained.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        protocol: Protocol,
        *,
        backend: str | Backend = "auto",
        on_event: OnEvent = lambda event: None,
        state: TrainState | None = None,
        init: Splats | None = None,
        options: TrainerOptions = TrainerOptions(),
    ) -> None:
        if not scene.train:
            raise DataError(f"scene {scene.name} has no training views")
        self.scene, self.recipe, self.protocol = scene, validate(recipe), protocol
        self._losses = losses_of(self.recipe)
        for stage in self.recipe.stages:
            protocol.resolve(stage.losses)  # each loss has a weight
        self.backend = backend if isinstance(backend, Backend) else get_backend(backend)
        self._on_event, self._options = on_event, options
        self.processes = processes = options.processes
        self.views = processes.size  # rendered in the last iteration
        self._pending: list[events.TrainingEvent] = []
        if state is not None and init is not None:
            raise RunError("training continues from a state or starts from init, got both; pass one of them")
        # A resumed training needs no start, but free space comes from the plane sweep, which is then repeated.
        goes_on = (init is not None and options.within is None) or (state is not None and self.recipe.removal is None)
        begins = replace(self.recipe, dense_start=None) if goes_on else self.recipe
        frozen = options.frozen
        self._frozen = None if frozen is None or len(frozen) == 0 else frozen.detach().to(self.backend.device)
        if self._frozen is not None and self._frozen.sh_degree != self.recipe.sh_degree:
            degrees = f"{self._frozen.sh_degree}, the recipe trains {self.recipe.sh_degree}"
            raise RecipeError(f"frozen splats must have the recipe's SH degree, got {degrees}; set sh_degree")
        scene, sweep = with_adjusted_cameras(scene, self.recipe.dense_start, processes)
        self.scene = scene
        self.learned = LearnedTable(self.recipe, scene)
        self._robust = Robustness(scene, begins, self.settings, self.backend, processes, self._frozen, sweep)
        whole, like = not needs_faces(self.recipe, protocol, self.backend), torch.zeros((), dtype=options.dtype)
        self._views = TrainedViews(scene.train, whole=whole, masks=protocol.use_mask_in_training, like=like)
        self._compared = replace(scene, train=self._views.views)
        self._learning = LearnedTable(self.recipe, self._compared)  # the same rows, by the views of iterations
        if state is not None:
            check_resumable(state, self.recipe, scene, views=len(self._views.views))
        self.state = processes.share(lambda: self._first_state(init) if state is None else state)
        self.state.trained_by(processes.size)
        self.state.move_to(self.backend.device)
        self.learned.move_to(self.state.learned, self.backend.device)
        self._robust.move_to(self.backend.device)
        self._learner = self.backend.for_training()
        around = (scene, self.settings, protocol.white, self._learner, processes)
        self._densifiers = [densifier_of(s.densify, Surroundings(s.name, *around)) for s in self.recipe.stages]
        self._actions: list[list[EntryAction]] = [
            [ACTIONS.make(action.name, options=action.options, where=f"stage {s.name!r}: ") for action in s.on_enter]
            for s in self.recipe.stages
        ]
        self._check_shared()
        # Of the current stage, from its first iteration on:
        self._objective: FullRender | CachedViews | None = None
        self._whole_steps: WholeSteps | None = None
        views = self._views.views
        self._ahead = ReadAhead(lambda index: views[index].image()) if scene.ahead else None
        needs = {need for _, loss in self._losses for need in loss.needs}
        self._needs_flatness = "flatness" in needs
        self._needs = needs | ({"silhouette"} if is_opaque(self.recipe) or self.learned.changes_color else set())
        self._whole = FullRender(
            self._compared,
            self.recipe,
            protocol,
            self._learner,
            self._targets(),
            frozen=self._frozen,
            learned=self._learning,
            cells=self._views.cells,
        )

    @property
    def splats(self) -> Splats:
        """The current splats."""
        return self.state.splats

    @property
    def drawn(self) -> Splats:
        """The current splats, followed by the frozen ones."""
        return self._whole.drawn(self.state.splats)

    @property
    def settings(self) -> RasterSettings:
        """The rasterizer's constants at the full SH degree, for evaluation and fusion."""
        return raster_settings(self.protocol, self.scene.extent, self.recipe.sh_degree, self.recipe.mip_px)

    def scene_now(self) -> Scene:
        """Return the scene with the learned quantities of its images and cameras, without what single images show."""
        return with_maps(self.learned.scene_now(self.state.learned), self.state)

    def _targets(self) -> TargetSource:
        scene = with_maps(self._compared, self.state, self._views.cells)
        return make_targets(scene, self.protocol, self.backend, self.state.splats, self._needs)

    @property
    def done(self) -> bool:
        """Whether every stage is finished."""
        return self.state.stage >= len(self.recipe.stages)

    def run(self) -> Splats:
        """Train from the current state to the end of the last stage."""
        while not self.done:
            if not self.state.entered:
                self.enter(self.state.stage)
            stage = self.recipe.stages[self.state.stage]
            while self.state.step < stage.iterations:
                self.step()
                if not is_async(self.state.splats.device):
                    self._options.between()
            self._finish(stage)
        return self.state.splats

    def enter(self, index: int) -> None:
        """Run the entry actions of a stage and prepare its first iteration."""
        state, stage = self.state, self.recipe.stages[index]
        state.stage, state.step, state.entered = index, 0, False
        self._objective = None
        while self._pending:  # from the start
            self._on_event(self._pending.pop(0))
        self._on_event(events.StageEntering(stage.name, index, len(state.splats)))
        entry = StageEntry(stage.name, self.scene, self._errors_by_view, self.processes)
        happened = [event for action in self._actions[index] for event in action.run(state, entry)]
        begin_stage(state, stage)
        state.statistics, densifier = None, self._densifiers[index]
        if densifier is not None:
            densifier.begin(state)
        self._check_parameters(stage, tuple(name for name, _ in state.splats.items()))
        trim()  # the start and the entry actions free much memory
        state.entered = True
        self.processes.check(state)
        for event in happened:
            self._on_event(event)
        self._on_event(events.StageStarted(stage.name, index, stage.iterations, len(state.splats)))

    def step(self) -> None:
        """Do one iteration of the current stage; W processes do W iterations of the schedule in one.

        A backend that does not wait for its device may have to repeat an iteration at the start of the next one
        (:meth:`gs2d.render.backends.Backend.iterate`). After a Progress event no iteration is pending.

        Raises
        ------
        DivergedError
            If the loss, a gradient or a parameter is NaN or infinite; names the iteration, the stage and the attribute.
            On a GPU this is detected at the next Progress event, before anything can be saved.
        """
        state = self.state
        stage, together = self.recipe.stages[state.stage], self.processes
        together.meet(state)
        iterations = self._iterations(stage)
        turns = [Turn(number, state.next_view(len(self._views.views))) for number in iterations]
        iteration, self.views = iterations[-1], len(iterations)
        if self._ahead is not None:
            self._ahead.expect(together.part(state.queue[-self.scene.ahead * together.size :][::-1]))
        if self._objective is None:
            limit = self._options.stage2_cache_bytes // together.place.local_size
            self._objective = choose_objective(self._whole, state, stage, limit, together.size)
            self._whole_steps = WholeSteps(self._whole, stage)
        reports = any(i % self._options.progress_every == 0 for i in iterations) or iteration == stage.iterations
        changes = any(self._changes(i) or self._robust.acts(stage, i) for i in iterations)
        result, happened = self._learner.iterate(
            partial(self._learn, stage, turns),
            rollback=partial(self._rollback, stage, turns),
            exact=reports or changes or together.size > 1,  # sums over processes cannot be undone
        )
        for number in iterations:
            happened += self._robust.remove(self.state, stage, number)
            if self._robust.compare(self.state, stage, number, shiny=self._needs_flatness):
                self._whole.targets = self._targets()
        state.step = iteration
        if changes:
            together.check(state)
        for event in happened:
            self._on_event(event)
        if reports:
            assert result is not None  # the iteration is exact
            losses = check_losses(stage, iteration, together.mean_losses(result.losses, self.views))
            self._check_parameters(stage, tuple(stage.train))  # on the CPU, gradients are checked in each iteration
            lr = lr_at(stage.lr.for_views(self.views), iteration, self.scene.extent)
            self._on_event(self._progress(stage, iteration, losses, lr))

    def _changes(self, iteration: int) -> bool:
        """Return whether the densifier of the current stage may change splats in an iteration."""
        densifier = self._densifiers[self.state.stage]
        return densifier is not None and densifier.changes(iteration)

    def _iterations(self, stage: Stage) -> range:
        """Return the iterations of the schedule to do in one step, at most one of them with densification."""
        first = self.state.step + 1
        stop, changed = min(first + self.processes.size, stage.iterations + 1), False
        for number in range(first, stop) if stop > first + 1 else ():
            changes = self._changes(number)
            if changes and changed:
                return range(first, number)
            changed |= changes
        return range(first, stop)

    def _learn(self, stage: Stage, turns: Sequence[Turn]) -> tuple[StepResult | None, list[events.TrainingEvent]]:
        """Compute gradients, densify and update; return the result, or None for an iteration done by the backend."""
        state, objective, densifier = self.state, self._objective, self._densifiers[self.state.stage]
        assert objective is not None
        assert self._whole_steps is not None
        iteration, together = turns[-1].iteration, self.processes
        at_once = together.size == 1 and objective is self._whole and self._learner.takes_whole_steps()
        if at_once and self._whole_steps.learn(state, iteration, turns[0].index, densifier):
            self._robust.decay(state, stage, iteration, self._learner)
            return None, []
        # Of the iterations that are done in one step, densification sees the one in which it is due.
        due = next((turn.iteration for turn in turns[:-1] if self._changes(turn.iteration)), iteration)
        probe = None if densifier is None else densifier.before_backward(state, due)
        result, of_views = together.evaluate(
            turns,
            lambda turn: objective.evaluate(state, stage, turn.iteration, turn.index, probe),
            lambda: no_view(state, stage, probe),
            rows=objective.rows,
            learned=self.learned.shapes,
        )
        happened = [] if densifier is None else list(densifier.after_backward(state, result, due))
        if not any(isinstance(event, events.Densified) for event in happened):
            limited = any(isinstance(event, events.OpacityLimited) for event in happened)
            rates = stage.lr.for_views(len(turns))
            skip, lr = ("opacity_logits",) if limited else (), lr_at(rates, iteration, self.scene.extent)
            options = {"backend": self._learner, "skip": skip, "rows": result.rows, "views": len(turns)}
            adam_step(state, stage, result.gradients, lr, **options)  # type: ignore[arg-type]
        for turn, gradients in zip(turns, of_views, strict=True):
            self._robust.decay(state, stage, turn.iteration, self._learner)
            learning = self.learned.learning(state.stage, turn.iteration)
            self._learning.update(state.learned, turn.index, gradients, learning, self._learner)
        return result, happened

    def _rollback(self, stage: Stage, turns: Sequence[Turn]) -> None:
        """Undo the counters of an iteration that the device cancelled."""
        for name, parameter in self.state.splats.items():
            if name in stage.train and parameter.numel() > 0:
                self.state.moments[name].steps -= len(turns)
        for turn in turns:
            rates = self.learned.learning(self.state.stage, turn.iteration)
            self._learning.rollback(self.state.learned, turn.index, rates)

    def _check_shared(self) -> None:
        """Raise RecipeError for a densifier that several processes cannot share."""
        many = self.processes.size
        for stage, densifier in zip(self.recipe.stages, self._densifiers, strict=True):
            if many == 1 or densifier is None:
                continue
            kind = type(densifier)
            if densifier.shares_views and kind.changes is not Densifier.changes:
                continue
            needs = "overrides Densifier.changes" if densifier.shares_views else "has shares_views = True"
            raise RecipeError(
                f"stage {stage.name!r}: training in {many} processes needs a densifier that {needs}, got "
                f"{kind.__name__}; train in one process"
            )

    def _first_state(self, init: Splats | None) -> TrainState:
        options = self._options
        generator = torch.Generator().manual_seed(self.recipe.seed)
        near = self.protocol.near_for(self.scene.extent)
        splats, event = self._robust.first_splats(near, generator, options.dtype, init, options.within)
        self._pending = [event]
        return TrainState(splats, generator, learned=self.learned.start(splats.means, {"exposure": options.exposures}))

    def _errors_by_view(self, occlusion: bool) -> Iterator[Tensor]:
        """Yield the inner sum of E_i [N] for each training view of this process."""
        for index in self.processes.part(range(len(self._views.views))):
            errors = self._whole.errors(self.state, index, self.drawn, self.settings, occlusion=occlusion)
            yield errors[: len(self.state.splats)]

    def _finish(self, stage: Stage) -> None:
        """Move the state to the next stage and send the event that this one is done."""
        state, index = self.state, self.state.stage
        unseen = self._drop_unseen(stage)
        state.stage, state.step, state.entered, state.statistics = index + 1, 0, False, None
        self._objective = None
        self._on_event(events.StageFinished(stage.name, index, stage.iterations, len(state.splats), unseen))

    def _drop_unseen(self, stage: Stage) -> int:
        """Drop the splats that no training view shows, and return how many.

        If splats that cross the near plane are not drawn whole, a splat can grow until no training view shows it, and
        then hide a new view. No pixel of a training view changes.
        """
        frozen = {"means", "quats", "log_scales", "opacity_logits"}.isdisjoint(stage.train)
        if frozen or self.protocol.near_plane_policy == "draw":
            return 0
        views = self.processes.part(self.scene_now().train)
        visible = self.processes.any(visible_mask(self.state.splats, views, self.settings, self.backend))
        unseen = int((~visible).sum())
        if unseen == len(self.state.splats):
            return 0  # an empty scene cannot be evaluated
        if unseen:
            keep_rows(self.state, visible)
        return unseen

    def _progress(
        self, stage: Stage, iteration: int, losses: Mapping[str, float], lr: Mapping[str, float]
    ) -> events.Progress:
        splats = self.state.splats
        return events.Progress(
            stage=stage.name,
            index=self.state.stage,
            iteration=iteration,
            iterations=stage.iterations,
            losses=losses,
            loss=sum(losses.values()),
            splats=len(self.state.splats),
            mean_opacity=float(splats.opacities.mean()),
            mean_k_a=float(splats.scales.prod(dim=1).mean()),
            lr={name: lr[name] for name in stage.train},
            sh_degree=stage.active_sh_degree(iteration, self.recipe.sh_degree),
        )

    def _check_parameters(self, stage: Stage, names: tuple[str, ...]) -> None:
        """Raise DivergedError if a parameter is not finite, because the rasterizer would ignore such a splat."""
        parameters = {name: tensor for name, tensor in self.state.splats.items() if name in names}
        broken = first_not_finite(parameters, self.backend)
        if broken is not None:
            raise diverged(stage, self.state.step, broken)
        values = {name: rows.values for name, rows in self.state.learned.items()}
        broken = first_not_finite_quantity(values, waits=True)
        if broken is not None:
            raise diverged(stage, self.state.step, f"learned {broken}")
