"""Listen to the trainer: write the log, checkpoints and results of stages, report progress, stop at signals."""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict
from types import FrameType
from typing import Any

from gs2d.config.recipe import Stage
from gs2d.errors import DivergedError, Gs2dError
from gs2d.io.run_dir import SPLATS, VERDICT, RunFolder, load_tensors
from gs2d.io.splat_ply import write_splats
from gs2d.pipeline.attempts import again, attempted
from gs2d.pipeline.finish.run_images import draw_stage
from gs2d.pipeline.finish.run_verdict import Collector
from gs2d.pipeline.finish.scoring import mean_psnr, peak_memory, score_views, split_metrics
from gs2d.pipeline.prepare.learned_views import write_appearance, write_maps, write_poses
from gs2d.pipeline.prepare.limits import release_buffers
from gs2d.pipeline.prepare.loaded import LoadedRun, Trained
from gs2d.pipeline.prepare.predicted_views import predicted, with_predicted
from gs2d.pipeline.prepare.resolve import checkpoint_interval
from gs2d.pipeline.train.resume import put_in_cache
from gs2d.training import events
from gs2d.training.events import Notice, OnEvent, Phase, StageScored, Step
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer

SIGNALS = (signal.SIGINT, signal.SIGTERM)
SAME = 1.0  # s; a second signal within this time is the first one, sent to the whole process group
LOG_LINES = 300  # progress lines per stage
PROBES, PROBE_VIEWS = 30, 4  # times per stage at which views are scored for the PSNR curve, and how many
REPORT_EVERY, REPORT_EVERY_ON_GPU = 10, 50  # iterations between progress events, for which the host waits for a GPU


class HeldSignals:
    """Delays signals between :meth:`hold` and :meth:`release`; a second signal acts at once.

    Delayed signals are passed to the previous handlers. Signals that are ignored, or that end the process, are not
    delayed, nor is any signal outside the main thread.
    """

    def __init__(self) -> None:
        self._previous: dict[int, Any] = {}
        self._heard: tuple[int, float] | None = None  # number, time in s

    @property
    def pending(self) -> bool:
        """Whether a signal is delayed."""
        return self._heard is not None

    def hold(self) -> None:
        """Start to delay signals."""
        if self._previous:
            return
        with contextlib.suppress(ValueError):  # not the main thread
            for number in SIGNALS:
                if callable(handler := signal.getsignal(number)):
                    signal.signal(number, self._keep)
                    self._previous[number] = handler

    def release(self) -> None:
        """Restore the handlers and deliver a delayed signal."""
        previous, heard = self._previous, self._heard
        self._previous, self._heard = {}, None
        for number, handler in previous.items():
            signal.signal(number, handler)
        if heard is not None:
            previous[heard[0]](heard[0], None)

    def forget(self) -> None:
        """Restore the handlers and drop a delayed signal."""
        self._heard = None
        self.release()

    def _keep(self, number: int, frame: FrameType | None) -> None:
        if self._heard is None:
            self._heard = (number, time.monotonic())
        elif time.monotonic() - self._heard[1] > SAME:
            self._previous[number](number, frame)


class StageClock:
    """Training time of a stage in seconds, without pauses for scores, log lines and checkpoints."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds
        self._started: float | None = None

    def start(self) -> None:
        """Start or continue."""
        self._started = time.perf_counter()

    def stop(self) -> None:
        """Stop and update ``seconds``."""
        if self._started is not None:
            self.seconds += time.perf_counter() - self._started
            self._started = None

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Pause inside the context."""
        self.stop()
        yield
        self.start()


class RunLogger:
    """Records a training run. It does not change what is trained.

    ``seconds`` is the training time already spent in the current stage; ``collected`` measures every view of the
    finished splats.
    """

    def __init__(
        self,
        run: RunFolder,
        loaded: LoadedRun,
        trainer: Trainer,
        seconds: float,
        on_event: OnEvent,
        collected: Collector | None,
    ) -> None:
        self._run, self._loaded, self._trainer, self._on_event = run, loaded, trainer, on_event
        self._collected = collected
        self._predicted: tuple[tuple[int, int], Trained] | None = None  # with its stage and step
        self._progress_every = progress_every(loaded)
        self._checkpoint_interval = checkpoint_interval(loaded.resolved.execution.checkpoint_every)
        self._clock = StageClock(seconds)
        self._saved_at, self._saved_iteration = time.perf_counter(), 0
        self.psnr: float | None = None  # of the probe views
        self._signals = HeldSignals()

    # -- called by the pipeline ----------------------------------------------------------------------------------------
    def begin(self) -> None:
        """Take over the state: score a finished stage that was not scored before an interruption, start the clock."""
        state = self._state
        if state.step == 0 and not state.entered:
            if state.stage > 0:
                self._take_over(state.stage - 1, self._costs())
            self._reset_stage()
        self._saved_iteration = state.step
        if state.processes and state.processes[-1][:2] == (state.stage, state.step):
            stage, count = min(state.stage, len(self._loaded.recipe.stages) - 1), self._trainer.processes.size
            fields = {"stage": self._stage(stage).name, "iteration": state.step, "count": count}
            self._run.events.append({"kind": "processes", **fields})
        self._phase()
        self._clock.start()
        if state.entered:
            self._signals.hold()

    def stop_if_requested(self) -> None:
        """Save a checkpoint and stop, if a signal requests it and training can resume from this iteration."""
        state, processes = self._state, self._trainer.processes
        if not (self._signals.pending or processes.stops) or not state.entered:
            return
        if state.step == self._stage(state.stage).iterations:
            return  # the checkpoint at the end of the stage is due
        if state.step > 0:
            self._clock.stop()
            try:
                self._save(state.stage, state.step)
            except Gs2dError as error:
                self._on_event(Notice(f"no checkpoint at iteration {state.step}: {error}"))
        self._signals.release()
        if processes.stops:  # another process received the signal
            raise KeyboardInterrupt

    @contextmanager
    def ending_well(self) -> Iterator[None]:
        """Name the last checkpoint in a DivergedError; restore the signal handlers at the end."""
        try:
            yield
        except DivergedError as error:
            saved = self._run.checkpoints()
            last = f"the last good checkpoint is {saved[-1].path}" if saved else "there is no checkpoint yet"
            raise DivergedError(f"{error}; {last}") from error
        finally:
            self._signals.forget()

    def on_training_event(self, event: events.TrainingEvent) -> None:
        """Log an event and do what is due."""
        if isinstance(event, events.Progress):
            self._on_progress(event)
            return
        if isinstance(event, events.StageEntering):
            self._reset_stage()
            self._clock.start()
        elif isinstance(event, events.StageFinished):
            self._clock.stop()
        elif isinstance(event, events.Initialised):
            self._on_event(Notice(start_text(event), detail=True))
        self._log(event)
        if isinstance(event, events.StageStarted):
            self._signals.hold()
        elif isinstance(event, events.StageFinished):
            self._finish_stage(event.index)

    # -- the log -------------------------------------------------------------------------------------------------------
    def _log(self, event: events.TrainingEvent, **extra: Any) -> None:
        fields = {k: v for k, v in asdict(event).items() if not isinstance(v, float) or math.isfinite(v)}
        self._run.events.append({"kind": event.kind, **fields, **extra})

    def _on_progress(self, event: events.Progress) -> None:
        last, total = event.iteration == event.iterations, self._iterations_before(event.index) + event.iteration
        if last or self._due(event.iteration, event.iterations, LOG_LINES):
            extra: dict[str, Any] = {"total_iteration": total, "mean_area": event.mean_k_a}
            with self._clock.paused():
                if last or self._due(event.iteration, event.iterations, PROBES):
                    psnr = self._probe_psnr()
                    if psnr is not None:
                        self.psnr = extra["psnr"] = psnr
            self._log(event, **extra)
        detail = (
            f"{event.stage} {event.iteration:,}/{event.iterations:,}  {event.splats:,} splats  loss {event.loss:.4f}"
        )
        self._on_event(Step(total, detail))
        iterations, seconds = self._checkpoint_interval
        due = iterations is not None and event.iteration - self._saved_iteration >= iterations
        late = seconds is not None and time.perf_counter() - self._saved_at >= seconds
        if (due or late) and not last:
            with self._clock.paused():
                self._save(event.index, event.iteration)

    def _due(self, iteration: int, iterations: int, count: int) -> bool:
        """Return whether something that happens about ``count`` times per stage was due in the last iteration."""
        every = max(1, math.ceil(iterations / count / self._progress_every)) * self._progress_every
        return iteration // every > (iteration - self._trainer.views) // every

    # -- checkpoints and stages ----------------------------------------------------------------------------------------
    def _save(self, index: int, iteration: int | None) -> None:
        """Write a checkpoint; ``iteration`` None: at the end of the stage."""
        key = self._loaded.stage_key(index, self._state.processes)
        payload = {"state": self._state.state_dict(), "seconds": self._clock.seconds, "key": key}
        self._run.save_checkpoint(index, self._stage(index).name, iteration, payload)
        self._saved_at, self._saved_iteration = time.perf_counter(), iteration or 0

    def _reset_stage(self) -> None:
        self._clock, self._saved_iteration = StageClock(), 0

    def _costs(self) -> dict[str, Any]:
        """Return the entry of a stage in ``metrics.json`` without its scores."""
        return {"seconds": round(self._clock.seconds, 3), "peak_memory_bytes": peak_memory()}

    def _finish_stage(self, index: int) -> None:
        self._save(index, None)
        if self._is_last(index):
            self._write_splats()
        self._signals.release()
        release_buffers()  # scoring has its own
        with self._attempted_at_end(index):
            self._score_stage(index, self._costs())
        if not self._is_last(index):
            self._phase()

    # -- results of stages ---------------------------------------------------------------------------------------------
    def _probe_psnr(self) -> float | None:
        """Return the mean PSNR of a few fixed views, test views if there are any."""
        # Exposures are predicted from neighbours only: measuring brightness would render every photograph.
        scene = with_predicted(self._trainer.scene_now())
        probes = scene.test or scene.train
        probes = probes[:: max(1, len(probes) // PROBE_VIEWS)][:PROBE_VIEWS]
        return mean_psnr(self._loaded.trained(self._trainer.drawn, scene), probes)

    def _take_over(self, index: int, costs: Mapping[str, Any]) -> None:
        """Draw a stage of another run or process, and score it if its scores or measures are missing."""
        stages = self._run.metrics()["stages"]
        if self._is_last(index):
            self._write_splats()
        unseen = self._collected is not None and not self._run.file(VERDICT).exists()
        with self._attempted_at_end(index):
            if len(stages) <= index:
                self._score_stage(index, costs)
            elif self._is_last(index) and unseen:
                self._score_stage(index, {**costs, **stages[-1]})
            else:
                self._draw(self._stage(index).name)

    def _write_splats(self) -> None:
        """Write the splats, refined cameras and learned appearance, before anything that could fail uses them."""
        with attempted("refined cameras and exposures", None, self._on_event):
            now = self._trainer.scene_now()
            write_poses(self._run, self._loaded.recipe, self._loaded.scene, now, self._on_event)
            write_appearance(self._run, now, self._on_event)
            write_maps(self._run, now, self._on_event)
        write_splats(self._run.file(SPLATS), self._trainer.splats)

    def _attempted_at_end(self, index: int) -> AbstractContextManager[None]:
        """Report errors after the last stage; raise them before."""
        if not self._is_last(index):
            return nullcontext()
        command = again("evaluate", self._run.path)
        return attempted(f"scores of stage {self._stage(index).name}", command, self._on_event)

    def _score_stage(self, index: int, costs: Mapping[str, Any]) -> None:
        """Score and draw a finished stage, write its entry of ``metrics.json``, put it into the cache."""
        stage, splats = self._stage(index), self._trainer.splats
        entry: dict[str, Any] = {
            "name": stage.name,
            "iterations": stage.iterations,
            "splats": len(splats),
            "bytes": splats.nbytes,
            **costs,
        }
        collected = self._collected if self._is_last(index) else None
        for split in ("train", "test"):
            entry |= {split: None, f"{split}_reason": "its views could not be scored"}
            with attempted(f"scores of {split} views, stage {stage.name}", None, self._on_event):
                shown = self._shown()
                views = shown.scene.train if split == "train" else shown.scene.test
                visitors = [] if collected is None else [collected.visit]
                scores = score_views(shown, views, self._on_event, split=split, visitors=visitors)
                del entry[f"{split}_reason"]
                entry |= split_metrics(scores, split)
        entry |= {} if collected is None else collected.transparent()
        self._draw(stage.name)
        stages = [*self._run.metrics()["stages"][:index], entry]
        self._run.write_metrics({"stages": stages, "surface": None})
        cache = self._loaded.resolved.execution.cache
        if cache is not None:
            saved = next(c for c in self._run.checkpoints() if c.stage_index == index and c.iteration is None)
            put_in_cache(cache, self._run, index, load_tensors(saved.path))
        self._on_event(StageScored(entry))

    def _draw(self, stage: str) -> None:
        drawn, state = self._trainer.drawn, self._trainer.state
        with attempted(f"images of stage {stage}", None, self._on_event):
            group = state.groups.get("high_error") if len(drawn) == len(state.splats) else None  # no frozen splats
            draw_stage(self._run, self._shown(), stage, group)

    def _shown(self) -> Trained:
        """Return the splats with the learned appearance of the scene, and predicted exposures of its test views."""
        at = (self._trainer.state.stage, self._trainer.state.step)
        if self._predicted is None or self._predicted[0] != at:
            now = self._loaded.trained(self._trainer.drawn, self._trainer.scene_now())
            self._predicted = (at, predicted(now))
        return self._predicted[1]

    # -- helpers -------------------------------------------------------------------------------------------------------
    @property
    def _state(self) -> TrainState:
        return self._trainer.state

    def _is_last(self, index: int) -> bool:
        return index == len(self._loaded.recipe.stages) - 1

    def _stage(self, index: int) -> Stage:
        return self._loaded.recipe.stages[index]

    def _iterations_before(self, index: int) -> int:
        return sum(stage.iterations for stage in self._loaded.recipe.stages[:index])

    def _phase(self) -> None:
        state, recipe = self._state, self._loaded.recipe
        done = self._iterations_before(state.stage) + state.step
        self._on_event(Phase(f"training {recipe.name}", recipe.iterations, done))


def progress_every(loaded: LoadedRun) -> int:
    """Return the iterations between progress events."""
    every = REPORT_EVERY if loaded.backend.on_host else REPORT_EVERY_ON_GPU
    return min(every, checkpoint_interval(loaded.resolved.execution.checkpoint_every)[0] or every)


def start_text(event: events.Initialised) -> str:
    """Return the source of the initial splats as text."""
    sources = {
        "points": "points of the capture",
        "sweep": "points on which neighbouring photographs agree, and points of the capture",
        "depths": "points of the capture and of its known depths",
        "splats": "initial splats",
        "random": "random points in the box that the cameras look at",
    }
    dropped = f" ({event.dropped:,} were not usable)" if event.dropped else ""
    failure = f"; no dense start: {event.lacks}" if event.lacks else ""
    return f"starting from {event.splats:,} {sources[event.source]}{dropped}{failure}"
