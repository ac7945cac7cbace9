"""The training loop: stages in order, each iteration in the order of the official 2DGS code.

loss, backward, statistics, densify and prune, opacity reset, Adam. So on an iteration that densifies nothing is updated
(its rows are new), and on one that resets opacity every other attribute is. No prints, no paths: events go out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import CloneInPlace, RankByError, Recipe, Stage, validate
from gs2d.core.memory import trim
from gs2d.core.memory_limit import cache_bytes
from gs2d.core.splats import Splats
from gs2d.data.cache import ReadAhead
from gs2d.data.scene import Scene
from gs2d.errors import DataError, RecipeError, RunError
from gs2d.losses.api import Loss, LossReport, losses_of, target_maps
from gs2d.render.backends import Backend, get_backend
from gs2d.render.types import RasterSettings
from gs2d.training import events
from gs2d.training.adam import adam_step, begin_stage, lr_at
from gs2d.training.blended_sums import blended_sums
from gs2d.training.cached_objective import choose_objective
from gs2d.training.densify.densifier import Densifier, Surroundings, densifier_of
from gs2d.training.initialize import initial_splats, splats_as_start
from gs2d.training.learned.learned_table import LearnedTable, first_not_finite_quantity
from gs2d.training.objective import (
    FullRender,
    Objective,
    StepResult,
    check_losses,
    diverged,
    first_not_finite,
    is_async,
    no_view,
    raster_settings,
    visible_mask,
)
from gs2d.training.opaque import is_opaque
from gs2d.training.parallel import ONE_PROCESS, OneProcess, Turn
from gs2d.training.priors import with_known_points
from gs2d.training.rank_clone import clone_in_place, rank_by_error
from gs2d.training.resumable import check_resumable
from gs2d.training.robust import Robustness
from gs2d.training.rows import keep_rows
from gs2d.training.state import TrainState
from gs2d.training.targets import PINNED_BYTES, TARGET_BYTES, DeviceTargets, Targets, TargetSource
from gs2d.training.whole_steps import WholeSteps

__all__ = ["OnEvent", "Trainer", "TrainerOptions", "raster_settings"]

OnEvent = Callable[[events.TrainingEvent], None]
MIN_START = 10  # splats that a dense start must find where there are others to start from
MIN_SIDE = 11  # px of a photograph in training: the window of SSIM


@dataclass(frozen=True, eq=False)
class TrainerOptions:
    """What else a training needs: its surroundings and its memory.

    Attributes
    ----------
    between : callable
        Called after each iteration on a device that nobody waits for (the CPU), when no event is due: a moment for
        something else that uses the rasterizer. It must leave the state alone.
    frozen : Splats or None
        Of the recipe's SH degree: rendered with those in training, and never changed, counted, densified or returned.
        They are what lies around a part of a scene that is trained by itself.
    within : callable or None
        Which places [M, 3] are to be trained, [M] bool. With ``init``, and where the recipe has a dense start: training
        starts from what that finds there, and from ``init`` only where photographs agree on nothing.
    exposures : Tensor [V, 3, 4] or None
        Transforms of the training views, for a recipe whose exposures are given.
    progress_every : int
        Iterations between Progress events (the last of a stage always sends one).
    target_bytes : int or None
        Memory for photographs: float tensors on the CPU (default 256 MiB), bytes on a GPU (default 2 GiB).
    stage2_cache_bytes : int
        Memory for cached views (cpu backend, stages that train only the colours of a row group); 0 = none. The first
        views that fit are cached. The result depends on it, by rounding.
    dtype : torch.dtype
        Of a new start.
    processes : OneProcess
        Those that train together (``training.parallel.ManyProcesses``), each with an own Trainer of the same scene and
        recipe. An iteration of W processes takes W views and counts as W of the schedule: ``state.step`` counts views.
        Process 0 has the ``state`` or ``init``, or makes the start, for all.
    """

    between: Callable[[], None] = lambda: None
    frozen: Splats | None = None
    within: Callable[[Tensor], Tensor] | None = None
    exposures: Tensor | None = None
    progress_every: int = 10
    target_bytes: int | None = None
    stage2_cache_bytes: int = 1 << 30
    dtype: torch.dtype = torch.float32
    processes: OneProcess = ONE_PROCESS


class Trainer:
    """Trains the splats of a scene by a recipe under a protocol.

    Parameters
    ----------
    scene : Scene
    recipe : Recipe
    protocol : Protocol
    backend : str or Backend
        Rasterizer: "auto", "cuda", "cpu" or "reference". Its device is where everything is kept.
    on_event : callable
        Gets every event; the state is whole then, so ``state.state_dict()`` may be saved. What it raises stops the run.
    state : TrainState, optional
        To go on from; without it training starts anew from ``recipe.seed``.
    init : Splats, optional
        To start anew from, instead of points: copied, with the recipe's SH degree.
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
        self.views = processes.size  # of the last iteration
        self._pending: list[events.TrainingEvent] = []
        if state is not None and init is not None:
            raise RunError("training goes on from a state or starts from init, got both; leave one out")
        # What goes on has begun; free space is found by the settings of the dense start, so that sweep is made again.
        goes_on = (init is not None and options.within is None) or (state is not None and self.recipe.removal is None)
        begins = replace(self.recipe, dense_start=None) if goes_on else self.recipe
        frozen = options.frozen
        self._frozen = None if frozen is None or len(frozen) == 0 else frozen.detach().to(self.backend.device)
        if self._frozen is not None and self._frozen.sh_degree != self.recipe.sh_degree:
            degrees = f"{self._frozen.sh_degree}, the recipe trains {self.recipe.sh_degree}"
            raise RecipeError(f"frozen splats must have the recipe's SH degree, got {degrees}; set sh_degree")
        self.learned = LearnedTable(self.recipe, scene)
        self._robust = Robustness(scene, begins, self.settings, self.backend, processes, self._frozen)
        if state is not None:
            check_resumable(state, self.recipe, scene)
        self.state = processes.share(lambda: self._new_state(init) if state is None else state)
        self.state.trained_by(processes.size)
        self.state.move_to(self.backend.device)
        self.learned.move_to(self.state.learned, self.backend.device)
        self._robust.move_to(self.backend.device)
        self._learner = self.backend.for_training()
        self._densifiers = [densifier_of(stage.densify, self._surroundings(stage)) for stage in self.recipe.stages]
        self._check_shared()
        self._objective: Objective | None = None  # of the stage under way, from its first iteration here
        self._whole_steps: WholeSteps | None = None  # likewise
        self._ahead = ReadAhead(lambda index: scene.train[index].image()) if scene.ahead else None
        self._downscale = 0  # nothing was looked at
        self._check_sizes()
        stage = self.recipe.stages[min(self.state.stage, len(self.recipe.stages) - 1)]
        self._look_at(stage.downscale_at(self.state.step + 1))

    @property
    def splats(self) -> Splats:
        """The splats as they are now."""
        return self.state.splats

    @property
    def drawn(self) -> Splats:
        """The splats as they are now, and in rows behind them those that are frozen: what photographs show."""
        return self._whole.drawn(self.state.splats)

    @property
    def settings(self) -> RasterSettings:
        """The rasterizer's constants at the full SH degree, for evaluation and fusion."""
        return raster_settings(self.protocol, self.scene.extent, self.recipe.sh_degree)

    def scene_now(self) -> Scene:
        """Return the scene with what was learned of its images and cameras."""
        return self.learned.scene_now(self.state.learned)

    @property
    def done(self) -> bool:
        """Whether every stage is finished."""
        return self.state.stage >= len(self.recipe.stages)

    @property
    def loss_reporters(self) -> Mapping[str, Loss]:
        """The losses of the recipe that have something to say in the report, by name."""
        return self._whole.losses.reporters

    def report_losses(self, index: int) -> dict[str, LossReport]:
        """Return what those losses say of training view ``index`` as it is now."""
        return self._whole.report(self.state, index, self.settings, self.backend)

    def run(self) -> Splats:
        """Train from where the state is to the end of the last stage."""
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
        self._objective = self._whole_steps = None
        self._look_at(stage.downscale_at(1))
        while self._pending:  # of who made the start
            self._on_event(self._pending.pop(0))
        self._on_event(events.StageEntering(stage.name, index, len(state.splats)))
        happened = [self._act(stage, action) for action in stage.on_enter]
        begin_stage(state, stage)
        state.statistics, densifier = None, self._densifiers[index]
        if densifier is not None:
            densifier.begin(state)
        self._check_parameters(stage, tuple(name for name, _ in state.splats.items()))
        trim()  # what finding the first splats, ranking and cloning left
        state.entered = True
        self.processes.check(state)
        for event in happened:
            self._on_event(event)
        self._on_event(events.StageStarted(stage.name, index, stage.iterations, len(state.splats)))

    def step(self) -> None:
        """One iteration of the stage that was entered; several processes do as many of the schedule in one.

        A backend that does not wait for its device may find that it changed nothing, and do it again at the start of
        the next one (:meth:`gs2d.render.backends.Backend.iterate`). After a Progress event everything is settled.

        Raises
        ------
        DivergedError
            NaN or infinity in the loss, a gradient or a parameter; names the iteration, the stage and the attribute. On
            a GPU, whose host does not wait for it, at the next Progress event, before anything could be saved.
        """
        state = self.state
        stage, together = self.recipe.stages[state.stage], self.processes
        together.meet(state)
        iterations = self._iterations(stage)
        turns = [Turn(number, state.next_view(len(self.scene.train))) for number in iterations]
        iteration, self.views = iterations[-1], len(iterations)
        self._look_at(stage.downscale_at(iteration))
        if self._ahead is not None:
            self._ahead.expect(together.part(state.queue[-self.scene.ahead * together.size :][::-1]))
        if self._objective is None:
            limit = self._options.stage2_cache_bytes // together.place.local_size
            self._objective = choose_objective(self._whole, state, stage, limit, together.size)
        reports = any(i % self._options.progress_every == 0 for i in iterations) or iteration == stage.iterations
        changes_rows = any(self._changes(i) or self._robust.removes(stage, i) for i in iterations)
        sharpens = stage.downscale_at(iteration + 1) != stage.downscale_at(iteration)  # then nothing may be done again
        result, happened = self._learner.iterate(
            partial(self._learn, stage, turns),
            rollback=partial(self._rollback, stage, turns),
            exact=reports or changes_rows or sharpens or together.size > 1,  # what is summed up cannot be taken back
        )
        for number in iterations:
            happened += self._robust.remove(self.state, stage, number)
        state.step = iteration
        if changes_rows:
            together.check(state)
        for event in happened:
            self._on_event(event)
        if reports:
            assert result is not None  # of an iteration that was looked at
            losses = check_losses(stage, iteration, together.mean_losses(result.losses, self.views))
            self._check_parameters(stage, tuple(stage.train))  # on a CPU gradients are checked each time
            lr = lr_at(stage.lr.for_views(self.views), iteration, self.scene.extent)
            self._on_event(self._progress(stage, iteration, losses, lr))

    def _changes(self, iteration: int) -> bool:
        """Whether the densifier of the stage under way may change splats in an iteration."""
        densifier = self._densifiers[self.state.stage]
        return densifier is not None and densifier.changes(iteration)

    def _iterations(self, stage: Stage) -> range:
        """Return the iterations of the schedule that are done in one: all at one size, one of them with densification.

        One process does one.
        """
        first = self.state.step + 1
        stop, changed = min(first + self.processes.size, stage.iterations + 1), False
        for number in range(first, stop) if stop > first + 1 else ():
            changes = self._changes(number)
            if (changes and changed) or stage.downscale_at(number) != stage.downscale_at(first):
                return range(first, number)
            changed |= changes
        return range(first, stop)

    def _learn(self, stage: Stage, turns: Sequence[Turn]) -> tuple[StepResult | None, list[events.TrainingEvent]]:
        """Gradients of a view, statistics and densification, Adam."""
        state, objective, densifier = self.state, self._objective, self._densifiers[self.state.stage]
        assert objective is not None
        iteration = turns[-1].iteration
        if self._learner.takes_whole_steps() and self._learn_at_once(stage, turns, densifier):
            self._robust.decay(state, stage, iteration, self._learner)
            return None, []
        # What densification is told: of the iterations that are done in one, that in which something is due.
        due = next((turn.iteration for turn in turns[:-1] if self._changes(turn.iteration)), iteration)
        probe = None if densifier is None else densifier.before_backward(state, due)
        result, of_views = self._evaluate(objective, stage, turns, probe)
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
            self.learned.update(state.learned, turn.index, gradients, learning, self._learner)
        return result, happened

    def _evaluate(
        self, objective: Objective, stage: Stage, turns: Sequence[Turn], probe: Tensor | None
    ) -> tuple[StepResult, Sequence[Mapping[str, Tensor]]]:
        """Gradients of the mean loss of some views, and those of each view."""
        state = self.state
        return self.processes.evaluate(
            turns,
            lambda turn: objective.evaluate(state, stage, turn.iteration, turn.index, probe),
            lambda: no_view(state, stage, probe),
            rows=objective.rows,
            learned=self.learned.shapes,
        )

    def _learn_at_once(self, stage: Stage, turns: Sequence[Turn], densifier: Densifier | None) -> bool:
        """Let the backend do an iteration of one process in one piece, if it is of a kind that it does."""
        if self.processes.size > 1:
            return False
        if self._whole_steps is None:
            self._whole_steps = WholeSteps(self._whole, self._objective, stage)
        return self._whole_steps.learn(self.state, turns[-1].iteration, turns[-1].index, densifier)

    def _rollback(self, stage: Stage, turns: Sequence[Turn]) -> None:
        """Take back what the host has counted of an iteration that changed nothing."""
        for name, parameter in self.state.splats.items():
            if name in stage.train and parameter.numel() > 0:
                self.state.moments[name].steps -= len(turns)
        for turn in turns:
            rates = self.learned.learning(self.state.stage, turn.iteration)
            self.learned.rollback(self.state.learned, turn.index, rates)

    def _check_shared(self) -> None:
        """Raise RecipeError for a stage that several processes cannot train."""
        many = self.processes.size
        for stage, densifier in zip(self.recipe.stages, self._densifiers, strict=True):
            if many == 1 or densifier is None:
                continue
            kind = type(densifier).__name__
            if not densifier.shares_views:
                raise RecipeError(
                    f"stage {stage.name!r}: its densifier must know several views in an iteration to train in {many} "
                    f"processes, got {kind}, which knows one (Densifier.shares_views); train in one process"
                )
            if type(densifier).changes is Densifier.changes:
                raise RecipeError(
                    f"stage {stage.name!r}: {kind} must say in which iterations it leaves splats alone to train in "
                    f"{many} processes, got one that may change them in each (Densifier.changes); train in one process"
                )

    def _surroundings(self, stage: Stage) -> Surroundings:
        """Where the densifier of a stage works."""

        def blame(state: TrainState, iteration: int, index: int) -> tuple[Tensor, Tensor]:
            found = self._whole.residual(state, stage, iteration, index)
            return blended_sums(state.splats, found, self._learner)

        around = (stage.name, self.scene, self.settings, self.protocol.white, self._learner, blame)
        return Surroundings(*around, processes=self.processes)

    def _check_sizes(self) -> None:
        """Raise RecipeError for a stage whose photographs would be too small to learn from."""
        least = min(min(view.camera.width, view.camera.height) for view in self.scene.train)
        for stage in self.recipe.stages:
            if stage.downscale > 1 and least // stage.downscale < MIN_SIDE:
                raise RecipeError(
                    f"stage {stage.name!r}: downscale must leave {MIN_SIDE} px of photographs whose shortest side is "
                    f"{least} px, got {stage.downscale}; --set {stage.name}.downscale={max(1, least // MIN_SIDE)}"
                )

    def _look_at(self, downscale: int) -> None:
        """Train on photographs of 1 / ``downscale`` of their size from now on; those of before are let go."""
        if downscale == self._downscale:
            return
        self._downscale, self._objective, self._whole_steps = downscale, None, None
        scene = self.scene.downscaled(downscale)
        self._targets: TargetSource = self._make_targets(scene, self._options.target_bytes)
        self._whole = FullRender(
            scene, self.recipe, self.protocol, self._learner, self._targets, self._frozen, self.learned
        )

    def _make_targets(self, scene: Scene, limit_bytes: int | None) -> TargetSource:
        """Return the photographs, where the splats are."""
        views, background, splats = scene.train, self.protocol.background, self.state.splats
        use_masks, dtype, device = self.protocol.use_mask_in_training, splats.dtype, splats.device
        if is_async(device):
            limit = 1 << 31 if limit_bytes is None else limit_bytes
            pinned = 0 if scene.ahead else cache_bytes(PINNED_BYTES)
            return DeviceTargets(
                views,
                background,
                use_masks=use_masks,
                device=device,
                dtype=dtype,
                limit_bytes=limit,
                pinned_bytes=pinned,
            )
        operations = self.backend.loss_operations(device)
        keeps = operations is not None and operations.blur is not None
        return Targets(
            views,
            background,
            use_masks=use_masks,
            maps=partial(target_maps, backend=self.backend) if keeps else None,
            with_silhouettes=is_opaque(self.recipe)
            or self.learned.changes_color
            or any("silhouette" in loss.needs for _, loss in self._losses),
            dtype=dtype,
            device=device,
            limit_bytes=limit_bytes if limit_bytes is not None else 0 if scene.ahead else TARGET_BYTES,
        )

    def _new_state(self, init: Splats | None) -> TrainState:
        dtype, exposures = self._options.dtype, self._options.exposures
        generator = torch.Generator().manual_seed(self.recipe.seed)
        found = None if init is not None and not self._robust.starts_densely else self._started(dtype, generator)
        if init is not None and (found is None or len(found) < MIN_START):
            found = splats_as_start(init, sh_degree=self.recipe.sh_degree, dtype=dtype)
            self._pending = [events.Initialised(len(found), "splats", 0)]
        assert found is not None
        state = TrainState(found, generator)
        state.learned = self.learned.start(found.means, {"exposure": exposures})
        return state

    def _started(self, dtype: torch.dtype, generator: torch.Generator) -> Splats:
        """Return the first splats as the recipe has them, of the places that are to be trained."""
        start = with_known_points(self._robust.scene, self.recipe)
        initial = initial_splats(
            start,
            sh_degree=self.recipe.sh_degree,
            random_points=self.recipe.init_points,
            near=self.protocol.near_for(self.scene.extent),
            generator=generator,
            dtype=dtype,
        )
        source = initial.source if start is self._robust.scene else "depths"
        source = "sweep" if source == "points" and self._robust.starts_densely else source
        splats = self._robust.fitted(initial)
        within = self._options.within
        splats = splats if within is None else splats.rows(within(splats.means))
        self._pending.append(events.Initialised(len(splats), source, initial.dropped, self._robust.lacks))
        return splats

    def _act(self, stage: Stage, action: RankByError | CloneInPlace) -> events.TrainingEvent:
        """Run an entry action."""
        if isinstance(action, CloneInPlace):
            count = clone_in_place(self.state, action)
            return events.Cloned(stage.name, action.writes, count, action.opacity, len(self.state.splats))
        errors = rank_by_error(self.state, action, self._errors_by_view(action.occlusion), self.processes.sum)
        group = self.state.groups[action.writes]
        fraction = float(errors[group].sum() / errors.sum().clamp(min=1e-300))
        return events.Ranked(stage.name, action.writes, int(group.sum()), float(errors[group].min()), fraction)

    def _errors_by_view(self, occlusion: bool) -> Iterator[Tensor]:
        """Yield the inner sum of E_i [N] for each training view that this process looks at."""
        for index in self.processes.part(range(len(self.scene.train))):
            found = self._whole.errors(self.state, index, self.drawn, self.settings, occlusion=occlusion)
            yield found[: len(self.state.splats)]

    def _finish(self, stage: Stage) -> None:
        """Point the state at the next stage and say that this one is done."""
        state, index = self.state, self.state.stage
        unseen = self._drop_unseen(stage)
        state.stage, state.step, state.entered, state.statistics = index + 1, 0, False, None
        self._objective = self._whole_steps = None
        self._on_event(events.StageFinished(stage.name, index, stage.iterations, len(state.splats), unseen))

    def _drop_unseen(self, stage: Stage) -> int:
        """Drop the splats that no training view sees; how many.

        Where crossing splats are not drawn whole, one can grow until no training view sees it, and hide a new view.
        No pixel of a training view changes.
        """
        frozen = {"means", "quats", "log_scales", "opacity_logits"}.isdisjoint(stage.train)
        if frozen or self.protocol.near_plane_policy == "draw":
            return 0
        views = self.processes.part(self.scene_now().train)
        seen = self.processes.any(visible_mask(self.state.splats, views, self.settings, self.backend))
        unseen = int((~seen).sum())
        if unseen == len(self.state.splats):
            return 0  # nothing is left to say what the scene is; evaluation will show it
        if unseen:
            keep_rows(self.state, seen)
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
        """Raise DivergedError if a parameter is not finite: the rasterizer would quietly leave such a splat out."""
        parameters = {name: tensor for name, tensor in self.state.splats.items() if name in names}
        broken = first_not_finite(parameters, self.backend)
        if broken is not None:
            raise diverged(stage, self.state.step, broken)
        values = {name: rows.values for name, rows in self.state.learned.items()}
        broken = first_not_finite_quantity(values, waits=True)
        if broken is not None:
            raise diverged(stage, self.state.step, f"learned {broken}")
