"""Results of the stages of a training: scores, images, entries of ``metrics.json``, and the finished splats."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from gs2d.config.recipe import Stage
from gs2d.data import Scene
from gs2d.evaluation.image_metrics import ImageMetrics
from gs2d.io.run_dir import SPLATS, VERDICT, RunFolder, load_tensors
from gs2d.io.splat_ply import write_splats
from gs2d.pipeline.attempts import again, attempted
from gs2d.pipeline.finish.run_images import choose_views, draw_stage
from gs2d.pipeline.finish.run_verdict import Collector
from gs2d.pipeline.finish.scoring import (
    Visitor,
    mean_psnr,
    score_views,
    split_metrics,
)
from gs2d.pipeline.prepare.learned_views import write_appearance, write_poses
from gs2d.pipeline.prepare.loaded import LoadedRun
from gs2d.pipeline.prepare.predicted_exposure import metered, with_predicted
from gs2d.pipeline.train.resume import put_in_cache
from gs2d.training.events import OnEvent, StageScored
from gs2d.training.trainer import Trainer

PROBE_VIEWS = 4


class StageResults:
    """Scores and draws the stages of a training, and writes their results.

    Parameters
    ----------
    run : RunFolder
    loaded : LoadedRun
    trainer : Trainer
    on_event : callable
    collected : Collector or None
        Measures every view of the finished splats.
    """

    def __init__(
        self, run: RunFolder, loaded: LoadedRun, trainer: Trainer, on_event: OnEvent, collected: Collector | None
    ) -> None:
        self._run, self._loaded, self._trainer, self._on_event = run, loaded, trainer, on_event
        self._collected = collected
        self._predicted: tuple[tuple[int, int], Scene] | None = None  # with its stage and step

    def probe_psnr(self) -> float | None:
        """Return the mean PSNR of a few fixed views, test views if there are any."""
        # Exposures are predicted from neighbours only: measuring brightness would render every photograph.
        scene = with_predicted(self._trainer.scene_now())
        probes = scene.test or scene.train
        probes = probes[:: max(1, len(probes) // PROBE_VIEWS)][:PROBE_VIEWS]
        return mean_psnr(self._trainer.drawn, probes, self._loaded.settings, self._loaded.backend)

    def score(self, index: int, facts: Mapping[str, Any]) -> None:
        """Score and draw a finished stage; ``facts`` go into its entry. After the last stage, errors are reported."""
        with self._attempted_at_end(index):
            self._score_stage(index, facts)

    def take_over(self, index: int, facts: Mapping[str, Any]) -> None:
        """Draw a stage of another run or process, and score it if its scores or measures are missing."""
        stages = self._run.metrics()["stages"]
        if self._is_last(index):
            self.write_splats()
        unseen = self._collected is not None and not self._run.file(VERDICT).exists()
        with self._attempted_at_end(index):
            if len(stages) <= index:
                self._score_stage(index, facts)
            elif self._is_last(index) and unseen:
                self._score_stage(index, {**facts, **stages[-1]})
            else:
                self._draw(self._stage(index).name)

    def write_splats(self) -> None:
        """Write the splats, refined cameras and learned appearance, before anything that could fail uses them."""
        with attempted("refined cameras and exposures", None, self._on_event):
            now = self._trainer.scene_now()
            write_poses(self._run, self._loaded.scene, now, self._on_event)
            write_appearance(self._run, now, self._on_event)
        write_splats(self._run.file(SPLATS), self._trainer.splats)

    @contextmanager
    def _attempted_at_end(self, index: int) -> Iterator[None]:
        """Report errors after the last stage; raise them before."""
        if not self._is_last(index):
            yield
            return
        with attempted(f"scores of stage {self._stage(index).name}", again("evaluate", self._run.path), self._on_event):
            yield

    def _score_stage(self, index: int, facts: Mapping[str, Any]) -> None:
        """Score and draw a finished stage, write its entry of ``metrics.json``, put it into the cache."""
        stage, last, splats = self._stage(index), self._is_last(index), self._trainer.splats
        entry: dict[str, Any] = {
            "name": stage.name,
            "iterations": stage.iterations,
            "splats": len(splats),
            "bytes": splats.nbytes,
            **facts,
        }
        collected = self._collected if last else None
        for split in ("train", "test"):
            entry |= {split: None, f"{split}_reason": "its views could not be scored"}
            with attempted(f"scores of {split} views, stage {stage.name}", None, self._on_event):
                scores = self._score(split, [] if collected is None else [collected.visit])
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

    def _score(self, split: str, visitors: Sequence[Visitor]) -> dict[str, ImageMetrics]:
        scene, loaded = self._shown_scene(), self._loaded
        views = scene.train if split == "train" else scene.test
        drawing = (loaded.settings, loaded.backend)
        return score_views(self._trainer.drawn, views, *drawing, self._on_event, split=split, visitors=visitors)

    def _draw(self, stage: str) -> None:
        drawn, state = self._trainer.drawn, self._trainer.state
        with attempted(f"images of stage {stage}", None, self._on_event):
            group = state.groups.get("high_error") if len(drawn) == len(state.splats) else None  # no frozen splats
            draw_stage(self._run, self._loaded, choose_views(self._shown_scene()), stage, drawn, group)

    def _shown_scene(self) -> Scene:
        """Return the scene with its learned appearance, and predicted exposures of its test views."""
        at = (self._trainer.state.stage, self._trainer.state.step)
        if self._predicted is None or self._predicted[0] != at:
            brightness = metered(self._trainer.drawn, self._loaded.settings, self._loaded.backend)
            self._predicted = (at, with_predicted(self._trainer.scene_now(), brightness))
        return self._predicted[1]

    def _is_last(self, index: int) -> bool:
        return index == len(self._loaded.recipe.stages) - 1

    def _stage(self, index: int) -> Stage:
        return self._loaded.recipe.stages[index]
