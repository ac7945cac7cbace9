"""Listens to the trainer: log, checkpoints, scores and pictures of each stage, progress for the user."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from types import MappingProxyType
from typing import Any

from gs2d.config.recipe import CloneInPlace, Stage
from gs2d.core.splats import Splats
from gs2d.data import Scene, View
from gs2d.errors import DivergedError, Gs2dError
from gs2d.evaluation.images import ImageMetrics
from gs2d.io.run_dir import SPLATS, VERDICT, RunFolder, load_tensors
from gs2d.io.splat_ply import write_splats
from gs2d.pipeline.attempts import again, attempted
from gs2d.pipeline.events import Notice, OnEvent, Phase, StageDone, Step
from gs2d.pipeline.finish.run_images import choose_views, draw_stage
from gs2d.pipeline.finish.scoring import (
    PeakGpuMemory,
    PeakMemory,
    SeenView,
    Visitor,
    evenly,
    is_partial,
    mean_psnr,
    score_views,
    split_metrics,
    transparent_entry,
    transparent_part,
)
from gs2d.pipeline.prepare.estimate import iteration_costs
from gs2d.pipeline.prepare.limits import release_buffers
from gs2d.pipeline.prepare.loaded import LoadedRun
from gs2d.pipeline.prepare.predicted_exposure import metered, with_predicted
from gs2d.pipeline.prepare.run_appearance import write_appearance
from gs2d.pipeline.prepare.run_poses import write_poses
from gs2d.pipeline.train.attribute_changes import Snapshot, mean_changes, take_snapshot
from gs2d.pipeline.train.interruption import HeldSignals
from gs2d.pipeline.train.loss_reports import report_losses
from gs2d.pipeline.train.resume import ResumePoint, put_in_cache
from gs2d.render.types import RenderOutput
from gs2d.training import events as train_events
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer

LOG_LINES = 300  # step lines a stage
PROBES = 30  # times a stage at which the probe views are scored for the PSNR curve
PROBE_VIEWS = 4
GROWTH = 1.1  # of the cost of iterations, while splats are added (``Phase.growth``)
EARLY_VIEWS = 16  # training views that score a stage before the last, where stages are compared by test views
REPORT_EVERY, REPORT_EVERY_ON_GPU = 10, 50  # iterations between progress events, for which the host waits for a GPU


class RunLogger:
    """The memory of a training run. Nothing it does changes what is trained.

    ``visitors`` see every view of the finished splats, while they are scored.
    """

    def __init__(
        self,
        run: RunFolder,
        loaded: LoadedRun,
        start: ResumePoint,
        on_event: OnEvent,
        visitors: Sequence[Visitor] = (),
    ) -> None:
        self._run, self._loaded, self._on_event = run, loaded, on_event
        self._execution = loaded.resolved.execution
        self._visitors = visitors
        self.progress_every = progress_every(loaded)
        self._shown = choose_views(loaded.scene)
        self._probes = (loaded.scene.test or loaded.scene.train)[
            :: max(1, len(loaded.scene.test or loaded.scene.train) // PROBE_VIEWS)
        ]
        self._probes = self._probes[:PROBE_VIEWS]
        self._memory, self._gpu_memory = PeakMemory(), PeakGpuMemory(loaded.backend)
        self._stage_clock = 0.0  # perf_counter() at which the stage would have begun without breaks
        self._seconds, self._peak = start.seconds, start.peak_memory
        self._at_entry = dict(start.at_entry)
        self._saved_at, self._saved_iteration = time.perf_counter(), 0
        self._trainer: Trainer | None = None
        self._predicted: tuple[tuple[int, int], Scene] | None = None  # of stage and step
        self.psnr: float | None = None  # of the probe views, the last time that they were scored
        self._before: Snapshot | None = None  # of the last step line, until it is compared with the next progress
        self._signals = HeldSignals()

    # -- called by the pipeline ----------------------------------------------------------------------------------------
    def begin(self, trainer: Trainer) -> None:
        """Take up a state: score a finished stage that was not scored before the break, start the clocks."""
        self._trainer = trainer
        state = trainer.state
        if state.step == 0 and not state.entered:
            self._finish_reused(state)
            self._seconds, self._peak, self._at_entry = 0.0, 0, {}
        elif state.step and self._step_line_due(state.step, self._stage(state.stage).iterations):
            self._before = take_snapshot(state.splats, state.step)  # as the run that was broken off had it
        self._saved_iteration = state.step
        if state.processes and state.processes[-1][:2] == (state.stage, state.step):
            stage, count = min(state.stage, len(self._loaded.recipe.stages) - 1), trainer.processes.size
            fact = {"stage": self._stage(stage).name, "iteration": state.step, "count": count}
            self._run.events.append({"kind": "processes", **fact})
        self._phase()
        self._start_clock()
        if state.entered:
            self._signals.hold()

    def stop_if_asked(self) -> None:
        """Save a checkpoint and stop, where a signal asks for it and this iteration can be gone on from."""
        assert self._trainer is not None
        if not (self._signals.asked or self._trainer.processes.stop_asked) or not self._state.entered:
            return
        state = self._state
        if self._before is not None and self._before.iteration != state.step:
            return  # the line of changes that is due would be lost: at most until the next progress
        if state.step == self._stage(state.stage).iterations:
            return  # the checkpoint at the end of the stage is due
        self._keep_what_is_trained()
        self._signals.release()
        if self._trainer.processes.stop_asked:  # another process heard it
            raise KeyboardInterrupt

    def _keep_what_is_trained(self) -> None:
        """Save a checkpoint between two iterations; one that cannot be saved stops nothing."""
        state = self._state
        if state.entered and state.step > 0:
            self._stop_clock()
            try:
                self._save(state.stage, state.step)
            except Gs2dError as error:
                self._on_event(Notice(f"no checkpoint at iteration {state.step}: {error}"))

    @contextmanager
    def ending_well(self) -> Iterator[None]:
        """Say in a DivergedError from where training can go on; signals act as before in the end."""
        try:
            yield
        except DivergedError as error:
            saved = self._run.checkpoints()
            last = f"the last good checkpoint is {saved[-1].path}" if saved else "there is no checkpoint yet"
            raise DivergedError(f"{error}; {last}") from error
        finally:
            self._signals.forget()

    def on_training_event(self, event: train_events.Event) -> None:
        """Log an event, and do what is due."""
        if isinstance(event, train_events.Progress):
            self._on_progress(event)
        elif isinstance(event, train_events.StageEntering):
            self._seconds, self._peak, self._at_entry, self._saved_iteration = 0.0, 0, {}, 0
            self._memory.reset()
            self._gpu_memory.reset()
            self._start_clock()
            self._log("stage_entering", event)
        elif isinstance(event, train_events.StageStarted):
            self._log("stage_start", event)
            self._score_entry(event)
            self._signals.hold()
        elif isinstance(event, train_events.StageFinished):
            self._stop_clock()
            self._log("stage_end", event)
            self._finish_stage(event.index)
        else:
            if isinstance(event, _ROWS_OR_JUMPS):
                self._before = None  # other rows, or a jump that no gradient made
            if isinstance(event, train_events.Initialised):
                self._on_event(Notice(start_text(event), detail=True))
            self._log(_KINDS[type(event)], event)

    # -- the log -------------------------------------------------------------------------------------------------------
    def _log(self, kind: str, event: Any, **extra: Any) -> None:
        facts = {name: value for name, value in asdict(event).items() if _storable(value)}
        self._run.events.append({"kind": kind, **facts, **extra})

    def _on_progress(self, event: train_events.Progress) -> None:
        last = event.iteration == event.iterations
        self._log_changes(event)
        if last or self._step_line_due(event.iteration, event.iterations):
            extra: dict[str, Any] = {"total_iteration": self._iterations_before(event.index) + event.iteration}
            extra["mean_area"] = event.mean_k_a
            if last or self._due(event.iteration, event.iterations, PROBES):
                psnr = self._probe_psnr(self._drawn)
                if psnr is not None:
                    self.psnr = psnr
                    extra["psnr"] = psnr
            self._log("step", event, **extra)
            if not last:
                self._stop_clock()
                self._before = take_snapshot(self._state.splats, event.iteration)
                self._start_clock()
        detail = (
            f"{event.stage} {event.iteration:,}/{event.iterations:,}  {event.splats:,} splats  loss {event.loss:.4f}"
        )
        self._on_event(Step(self._iterations_before(event.index) + event.iteration, detail))
        due = event.iteration - self._saved_iteration >= self._execution.checkpoint_every
        late = time.perf_counter() - self._saved_at >= self._execution.checkpoint_seconds
        if (due or late) and not last:
            self._stop_clock()
            self._save(event.index, event.iteration)
            self._start_clock()

    def _step_line_due(self, iteration: int, iterations: int) -> bool:
        return self._due(iteration, iterations, LOG_LINES)

    def _due(self, iteration: int, iterations: int, count: int) -> bool:
        """Whether a multiple of the progress that is one of about ``count`` of a stage was in the last iteration."""
        assert self._trainer is not None
        every = max(1, math.ceil(iterations / count / self.progress_every)) * self.progress_every
        return iteration // every > (iteration - self._trainer.views) // every

    def _log_changes(self, event: train_events.Progress) -> None:
        """Log what the iterations since the last step line changed, if that was one progress ago."""
        before, self._before = self._before, None
        if before is None:
            return
        self._stop_clock()
        over = event.iteration - before.iteration
        changes = mean_changes(before, self._state.splats, iterations=over, extent=self._loaded.scene.extent)
        fact = {"stage": event.stage, "iteration": event.iteration, "over": over}
        self._run.events.append({"kind": "changes", **fact, **changes})
        self._start_clock()

    def _probe_psnr(self, splats: Splats) -> float | None:
        """Mean PSNR over a few fixed views (test views where there are any)."""
        self._stop_clock()
        # By neighbours alone: what the camera would see costs a rendering of every photograph.
        views = self._now(self._probes, with_predicted(self._scene_now))
        psnr = mean_psnr(splats, views, self._settings, self._loaded.backend)
        self._start_clock()
        return psnr

    # -- checkpoints ---------------------------------------------------------------------------------------------------
    def _payload(self, index: int) -> dict[str, Any]:
        extra = {"seconds": self._seconds, "peak_memory": self._peak, "at_entry": self._at_entry}
        state = self._state
        key = self._loaded.stage_key(index, state.processes)
        return {"state": state.state_dict(), "extra": json.dumps(extra), "key": key}

    def _save(self, index: int, iteration: int | None) -> None:
        self._peak = max(self._peak, self._memory.read())
        self._run.save_checkpoint(index, self._stage(index).name, iteration, self._payload(index))
        self._saved_at, self._saved_iteration = time.perf_counter(), iteration or 0

    # -- stages --------------------------------------------------------------------------------------------------------
    def _score_entry(self, event: train_events.StageStarted) -> None:
        """Score just after the entry actions, to compare with the stage before: the price of the clone."""
        if not any(isinstance(action, CloneInPlace) for action in self._stage(event.index).on_enter):
            return
        self._stop_clock()
        for split, views in self._scored(last=False):
            with attempted(f"scores of {split} views after the clone", "", self._on_event):
                scores = self._score(split, views, f"scoring after the clone ({split})")
                self._at_entry |= split_metrics(scores, split, of=len(self._views(split)))
        self._run.events.append({"kind": "after_clone", "stage": event.stage, **self._at_entry})
        self._phase()
        self._start_clock()

    def _finish_stage(self, index: int) -> None:
        self._save(index, None)
        if self._is_last(index):
            self._write_results()
        self._signals.release()
        release_buffers()  # scoring has its own
        with self._attempted_at_end(index):
            self._score_stage(index)
        if index + 1 < len(self._loaded.recipe.stages):
            self._phase()

    def _finish_reused(self, state: TrainState) -> None:
        """Pictures of the stages taken over, and the scores of one that was killed before it was scored."""
        stages, index = self._run.metrics()["stages"], state.stage - 1
        if index < 0:
            return
        if self._is_last(index):
            self._write_results()
        with self._attempted_at_end(index):
            if len(stages) <= index:
                self._score_stage(index)
            elif self._is_last(index) and (self._unseen or is_partial(stages[-1])):
                self._score_stage(index, taken_over=stages[-1])  # the last one here: every view has to be seen
            else:
                self._draw(self._stage(index).name)

    def _write_results(self) -> None:
        """Write the splats and what belongs to them, before anything that is made of them can fail."""
        run, loaded, state = self._run, self._loaded, self._state
        with attempted("learned cameras and exposures", None, self._on_event):
            now = self._scene_now
            write_poses(run, loaded.scene, now, self._on_event)
            write_appearance(run, now, self._on_event)
        write_splats(run.file(SPLATS), state.splats)

    @contextmanager
    def _attempted_at_end(self, index: int) -> Iterator[None]:
        """After the last stage, report an error and go on; before it, raise it."""
        if not self._is_last(index):
            yield
            return
        with attempted(f"scores of stage {self._stage(index).name}", again("evaluate", self._run.path), self._on_event):
            yield

    def _score_stage(self, index: int, taken_over: Mapping[str, Any] = MappingProxyType({})) -> None:
        """Score a finished stage, draw it, write its entry of metrics.json, put it in the cache.

        ``taken_over`` is the entry of the same stage in another run, of which the scores are done again.
        """
        state, stage, last = self._state, self._stage(index), self._is_last(index)
        entry: dict[str, Any] = {
            "name": stage.name,
            "iterations": stage.iterations,
            "seconds": round(self._seconds, 3),
            "splats": len(state.splats),
            "bytes": state.splats.nbytes,
            "peak_memory_bytes": self._peak,
        }
        if self._gpu_memory.read():
            entry["peak_gpu_memory_bytes"] = self._gpu_memory.read()  # before scoring adds to it
        if self._at_entry:
            entry["after_clone"] = self._at_entry
        entry |= taken_over
        shown = {view.name for _, view in self._shown}
        outputs: dict[str, RenderOutput] = {}
        transparent: dict[str, float] = {}

        def keep(seen: SeenView, scores: ImageMetrics) -> None:
            if seen.view.name in shown:
                outputs[seen.view.name] = seen.output
            part = transparent_part(seen) if seen.split == "train" else None
            if part is not None and math.isfinite(part):  # a mask may leave no pixel
                transparent[seen.view.name] = part

        for split, views in self._scored(last=last):
            entry |= {split: None, f"{split}_reason": "its views could not be scored"}
            with attempted(f"scores of {split} views, stage {stage.name}", None, self._on_event):
                visitors = [keep, *(self._visitors if last else ())]
                scores = self._score(split, views, f"scoring {split} views", visitors)
                del entry[f"{split}_reason"]
                entry |= split_metrics(scores, split, of=len(self._views(split)))
        entry |= transparent_entry(transparent)
        with attempted(f"what the losses say of stage {stage.name}", None, self._on_event):
            assert self._trainer is not None
            entry |= report_losses(self._run, self._trainer, self._loaded.scene.train)
        self._draw(stage.name, outputs)
        stages = [*self._run.metrics()["stages"][:index], entry]
        self._run.write_metrics({"stages": stages, "surface": None})
        if self._execution.cache is not None:
            saved = next(c for c in self._run.checkpoints() if c.stage_index == index and c.iteration is None)
            put_in_cache(self._execution.cache, self._run, index, load_tensors(saved.path))
        self._on_event(StageDone(entry))

    def _scored(self, *, last: bool) -> list[tuple[str, Sequence[View]]]:
        """Return the views that score a stage: all, but before the last stage some of the training views.

        Where training views are what stages are compared by (DTU, captures without test views) all of them do.
        """
        scene = self._loaded.scene
        compared = self._loaded.protocol.test_on == "train" or not scene.test
        train = scene.train if last or compared else evenly(scene.train, EARLY_VIEWS)
        return [("train", train), ("test", scene.test)]

    def _score(self, split: str, views: Sequence[View], name: str, visitors: Sequence[Visitor] = ()) -> Any:
        return score_views(
            self._drawn,
            self._now(views, self._scene_shown),
            self._settings,
            self._loaded.backend,
            name=name,
            on_event=self._on_event,
            split=split,
            visitors=visitors,
        )

    def _draw(self, stage: str, outputs: Mapping[str, RenderOutput] = MappingProxyType({})) -> None:
        state = self._state
        views = self._now([view for _, view in self._shown], self._scene_shown)
        shown = zip((split for split, _ in self._shown), views, strict=True)
        with attempted(f"pictures of stage {stage}", None, self._on_event):
            group = _group(state) if len(self._drawn) == len(state.splats) else None  # none of what is frozen
            draw_stage(self._run, self._loaded, list(shown), stage, self._drawn, group, outputs)

    # -- small things --------------------------------------------------------------------------------------------------
    @property
    def _settings(self) -> Any:
        return self._loaded.settings

    @property
    def _scene_now(self) -> Scene:
        assert self._trainer is not None
        return self._trainer.scene_now()

    @property
    def _scene_shown(self) -> Scene:
        """The scene with what was learned of it, and predicted exposures of its test views."""
        at = (self._state.stage, self._state.step)
        if self._predicted is None or self._predicted[0] != at:
            brightness = metered(self._drawn, self._settings, self._loaded.backend)
            self._predicted = (at, with_predicted(self._scene_now, brightness))
        return self._predicted[1]

    def _now(self, views: Sequence[View], scene: Scene) -> list[View]:
        """Return views of the capture as a scene with what was learned has them."""
        now = dict(zip(map(id, self._loaded.scene.views), scene.views, strict=True))
        return [now.get(id(view), view) for view in views]

    @property
    def _state(self) -> TrainState:
        assert self._trainer is not None
        return self._trainer.state

    @property
    def _drawn(self) -> Splats:
        """The splats as photographs show them: with those that are frozen around them."""
        assert self._trainer is not None
        return self._trainer.drawn

    @property
    def _unseen(self) -> bool:
        """Whether nobody has looked at the views of the finished splats yet."""
        return bool(self._visitors) and not self._run.file(VERDICT).exists()

    def _views(self, split: str) -> Sequence[View]:
        return self._loaded.scene.train if split == "train" else self._loaded.scene.test

    def _is_last(self, index: int) -> bool:
        return index == len(self._loaded.recipe.stages) - 1

    def _stage(self, index: int) -> Stage:
        return self._loaded.recipe.stages[index]

    def _iterations_before(self, index: int) -> int:
        return sum(stage.iterations for stage in self._loaded.recipe.stages[:index])

    def _phase(self) -> None:
        state = self._state
        done = self._iterations_before(state.stage) + state.step
        recipe = self._loaded.recipe
        costs = iteration_costs(recipe)
        self._on_event(Phase(f"training {recipe.name}", recipe.iterations, done, growth=GROWTH, costs=costs))

    def _start_clock(self) -> None:
        self._stage_clock = time.perf_counter() - self._seconds

    def _stop_clock(self) -> None:
        self._seconds = time.perf_counter() - self._stage_clock


_KINDS = {
    train_events.Initialised: "initialised",
    train_events.Ranked: "ranked",
    train_events.Cloned: "cloned",
    train_events.Densified: "densify",
    train_events.OpacityLimited: "opacity_limited",
    train_events.FloatersRemoved: "floaters_removed",
}
_ROWS_OR_JUMPS = (
    train_events.Densified,
    train_events.OpacityLimited,
    train_events.FloatersRemoved,
)


def progress_every(loaded: LoadedRun) -> int:
    """Return the iterations between progress events."""
    every = REPORT_EVERY if loaded.backend.on_host else REPORT_EVERY_ON_GPU
    return max(1, min(every, loaded.resolved.execution.checkpoint_every))


def _storable(value: Any) -> bool:
    return not isinstance(value, float) or math.isfinite(value)


def _group(state: TrainState) -> Any:
    """Return the rows to highlight, once they are known."""
    return state.groups.get("high_error")


def start_text(event: train_events.Initialised) -> str:
    """Return what training starts from, in words."""
    sources = {
        "points": "points of the capture",
        "sweep": "places on which neighbouring photographs agree, and points of the capture",
        "depths": "points of the capture and of its known depths",
        "splats": "given splats",
        "random": "random points in the box the cameras look at",
    }
    source = sources[event.source]
    dropped = f" ({event.dropped:,} were not usable)" if event.dropped else ""
    lacks = f"; no dense start: {event.lacks}" if event.lacks else ""
    return f"starting from {event.splats:,} {source}{dropped}{lacks}"
