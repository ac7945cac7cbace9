"""What a training starts from, and how long it will take, from a few iterations of it that are thrown away."""

from __future__ import annotations

import itertools
import statistics
import time
from dataclasses import dataclass, replace

from gs2d.config.recipe import Recipe
from gs2d.errors import Gs2dError
from gs2d.pipeline.events import duration
from gs2d.pipeline.job import Job
from gs2d.training.events import Initialised
from gs2d.training.trainer import Trainer

WARM_UP, FEWEST, MOST = 2, 3, 30  # iterations
MEASURED_SECONDS = 3.0
# Seconds of a whole training over iterations x seconds of its first ones: docs/decisions/terminal.md has the captures.
MIN_GROWTH, MAX_GROWTH = 1.0, 4.0


@dataclass(frozen=True)
class Estimate:
    """Seconds that training takes, between two bounds, from ``iteration``: seconds of an iteration at its start."""

    iteration: float
    least: float
    most: float


def estimate(job: Job) -> Estimate | None:
    """Measure the first iterations of a job and forget them; None where they fail, of which training itself will tell.

    Iterations get slower while splats are added, so that the first ones tell a lower bound; how much slower is known
    from other captures only. They are measured on photographs of the full size; of smaller ones an iteration takes at
    least as much less as they have fewer pixels.
    """
    first, *rest = job.recipe.stages
    full = replace(job.recipe, stages=(replace(first, downscale=1, halve_at=()), *rest))
    try:
        trainer = Trainer(job.scene, full, job.protocol, backend=job.backend, init=job.init, progress_every=1)
        trainer.enter(0)
        iteration = seconds_of(trainer, first.iterations)
    except Gs2dError:
        return None
    if iteration is None:
        return None
    most = MAX_GROWTH * iteration * job.recipe.iterations
    return Estimate(iteration, MIN_GROWTH * iteration * full_iterations(job.recipe), most)


def full_iterations(recipe: Recipe) -> float:
    """Return the iterations of a recipe, each counted as the fraction of pixels that its photographs have."""
    return sum(count * cost for count, cost in iteration_costs(recipe))


def iteration_costs(recipe: Recipe) -> tuple[tuple[int, float], ...]:
    """Return runs of iterations of a recipe, with the fraction of pixels that its photographs have there."""
    each = (1 / stage.downscale_at(i) ** 2 for stage in recipe.stages for i in range(1, stage.iterations + 1))
    return tuple((sum(1 for _ in run), cost) for cost, run in itertools.groupby(each))


def seconds_of(trainer: Trainer, iterations: int) -> float | None:
    """Return the median of some iterations without the first, which compile and decode; None if too few."""
    taken: list[float] = []
    begun = time.perf_counter()
    for number in range(min(iterations, WARM_UP + MOST)):
        started = time.perf_counter()
        trainer.step()
        if number >= WARM_UP:
            taken.append(time.perf_counter() - started)
        if len(taken) >= FEWEST and time.perf_counter() - begun > MEASURED_SECONDS:
            break
    return statistics.median(taken) if len(taken) >= FEWEST else None


def estimate_text(found: Estimate, iterations: int) -> str:
    """Return the estimate for people."""
    return (
        f"training will take about {duration(found.least)} to {duration(found.most)}: {iterations:,} iterations, "
        f"{found.iteration * 1000:.0f} ms each at the start and more as splats are added"
    )


def start_text(event: Initialised) -> str:
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
