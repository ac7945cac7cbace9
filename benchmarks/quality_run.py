"""Run one training of the time-to-quality curves in its own process (started by ``benchmarks/time_to_quality.py``).

Scores are computed while the clocks are stopped. At every point of the curve, the state is saved with the clocks, so
that an interrupted training resumes from there. Work after the last saved point is repeated and counted once. The same
holds for process start, reading the capture and the initialisation of the splats (a plane sweep).
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any

import torch

from gs2d.core.json_files import write_json
from gs2d.core.splats import Splats
from gs2d.data import Scene
from gs2d.errors import Gs2dError
from gs2d.pipeline.prepare.limits import use_threads
from gs2d.pipeline.prepare.loaded import LoadedRun, prepare_run
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.training import events
from gs2d.training.events import ignore
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer, TrainerOptions

SPEC, RESULT, STATE = "spec.json", "result.json", "state.pt"
PROGRESS_EVERY = 10  # iterations, granularity of the points on the curve


@dataclass(frozen=True)
class Spent:
    """Wall seconds, CPU seconds in user mode, and CPU seconds in the system."""

    seconds: float = 0.0
    user_seconds: float = 0.0
    system_seconds: float = 0.0

    def __add__(self, other: Spent) -> Spent:
        return Spent(
            self.seconds + other.seconds,
            self.user_seconds + other.user_seconds,
            self.system_seconds + other.system_seconds,
        )

    def __sub__(self, other: Spent) -> Spent:
        return self + Spent(-other.seconds, -other.user_seconds, -other.system_seconds)


class Clocks:
    """Clocks of a training that can be stopped.

    Parameters
    ----------
    started : float
        Start time of the process (``time.time()``).
    """

    def __init__(self, started: float) -> None:
        self._started, self._offset = started, Spent()

    def _now(self) -> Spent:
        used = resource.getrusage(resource.RUSAGE_SELF)
        return Spent(time.time() - self._started, used.ru_utime, used.ru_stime)

    def spent(self) -> Spent:
        """Return the time spent until now, to a millisecond."""
        exact = self._now() - self._offset
        return Spent(*(round(value, 3) for value in astuple(exact)))

    def set(self, spent: Spent) -> None:
        """Continue from the time spent by an earlier process."""
        self._offset = self._now() - spent

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Stop the clocks within the context."""
        before = self._now()
        yield
        self._offset = self._offset + (self._now() - before)


def train_options(spec: dict[str, Any], folder: Path) -> TrainOptions:
    """Return the options of a training, as ``gs2d train`` sets them."""
    return TrainOptions(
        scene=Path(spec["capture"]),
        out=folder,  # only the folder is used
        recipe=spec["recipe"],
        schedule_scale=spec["scale"],
        downscale=spec["downscale"],
        seed=spec["seed"],
        overrides=tuple(spec["set"]),
        backend=spec["backend"],
    )


def marks(iterations: int, points: int) -> list[int]:
    """Return evenly spaced iterations at which the curve has a point, without the last iteration."""
    return sorted({round(iterations * k / points) for k in range(1, points)} - {0, iterations})


def train(spec: dict[str, Any], folder: Path, clocks: Clocks) -> dict[str, Any]:
    """Train, score at intermediate points and at the end, and return the entry of the results file."""
    use_threads(spec["threads"])
    job = prepare_run(train_options(spec, folder), ignore)
    state, course = _saved(folder / STATE, clocks)
    waiting = [mark for mark in marks(job.recipe.iterations, spec["points"]) if mark > _done(job, state)]

    def listen(event: events.TrainingEvent) -> None:
        if not isinstance(event, events.Progress):
            return
        done = sum(stage.iterations for stage in job.recipe.stages[: event.index]) + event.iteration
        if not waiting or done < waiting[0] or done == job.recipe.iterations:
            return
        while waiting and waiting[0] <= done:
            waiting.pop(0)
        with clocks.stopped():
            course.append(
                {"iterations": done, **asdict(clocks.spent()), **score_splats(job, trainer.splats, trainer.scene_now())}
            )
            _save(folder / STATE, trainer.state, clocks.spent(), course)

    every = PROGRESS_EVERY
    trainer = Trainer(
        job.scene,
        job.recipe,
        job.protocol,
        backend=job.backend,
        on_event=listen,
        state=state,
        options=TrainerOptions(progress_every=every),
    )
    trainer.run()
    spent = clocks.spent()
    result = {
        "iterations": job.recipe.iterations,
        **asdict(spent),
        **score_splats(job, trainer.splats, trainer.scene_now()),
    }
    return {**result, **surface(job, trainer, spec, folder), "course": course}


def _done(job: LoadedRun, state: TrainState | None) -> int:
    """Return the number of finished iterations of a state."""
    if state is None:
        return 0
    return sum(stage.iterations for stage in job.recipe.stages[: state.stage]) + state.step


def _saved(file: Path, clocks: Clocks) -> tuple[TrainState | None, list[dict[str, Any]]]:
    """Return the saved state and curve of an interrupted training, and set the clocks."""
    if not file.exists():
        return None, []
    data = torch.load(file, weights_only=True)
    clocks.set(Spent(**data["spent"]))
    return TrainState.from_state_dict(data["state"]), list(data["course"])


def _save(file: Path, state: TrainState, spent: Spent, course: list[dict[str, Any]]) -> None:
    temporary = file.with_suffix(".tmp")
    torch.save({"state": state.state_dict(), "spent": asdict(spent), "course": course}, temporary)
    os.replace(temporary, file)


def score_splats(job: LoadedRun, splats: Splats, learned: Scene | None = None) -> dict[str, Any]:
    """Return the scores of the test views (of the training views if there are none), and the number of splats.

    ``learned`` is the scene as learned with the splats.
    """
    # Imported while the clocks are stopped: training does not need these modules.
    from benchmarks.street_runs import summary_of
    from gs2d.pipeline.finish.scoring import score_views
    from gs2d.pipeline.prepare.predicted_views import predicted

    shown = predicted(job.trained(splats, learned))
    scores = score_views(shown, shown.scene.test or shown.scene.train, ignore)
    summary = dict(summary_of(scores) or {})
    summary.pop("psnr_by_view", None)
    size = float(splats.scales.max()) / job.scene.extent
    return {"images": summary, "splats": len(splats), "longest_splat": round(size, 4)}


def surface(job: LoadedRun, trainer: Trainer, spec: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the mesh quality and the meshing seconds, if there is a true surface."""
    from gs2d.contrib.lab.surface_protocols import VISIBLE_SURFACE
    from gs2d.evaluation.evaluators import GENERAL, choose_truth, score_surface
    from gs2d.pipeline.in_memory import Trained, extract_mesh

    given = None if spec["ground_truth"] is None else Path(spec["ground_truth"])
    root = job.scene.root or Path(".")
    truth = choose_truth(given, root, lambda text: None)
    if truth is None or truth.name != GENERAL:  # official metrics have no F-score at a fraction of the size
        return {"surface": None}
    start = time.process_time()
    scene = trainer.scene_now()
    mesh = extract_mesh(Trained(trainer.splats, scene, job.protocol, job.settings, job.backend, job.recipe))
    seconds = time.process_time() - start
    found = score_surface(mesh, truth, job.scene, folder=folder / "surface", notify=lambda text: None)
    fractions = map(str, VISIBLE_SURFACE.fractions)
    return {
        "surface": {
            "f_scores": {name: row["f_score"] for name, row in zip(fractions, found["thresholds"], strict=True)},
            "chamfer": found["chamfer"],
            "faces": len(mesh.faces),
            "mesh_cpu_seconds": round(seconds, 2),
        }
    }


def main(arguments: list[str]) -> int:
    """Train a spec and write ``result.json`` next to it; return 2 for user errors."""
    file, started = Path(arguments[0]), float(arguments[1])
    folder = file.parent
    try:
        result = train(json.loads(file.read_text()), folder, Clocks(started))
    except Gs2dError as error:
        print(error)
        return 2
    write_json(folder / RESULT, result)
    (folder / STATE).unlink(missing_ok=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
