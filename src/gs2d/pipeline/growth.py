"""How splats multiply: densification tried on a few photographs for seconds, and what it will come to.

A splat of a large capture is seen by few of its photographs, one of the few that are tried by nearly all of these. So
between two densifications here there are as many iterations as show a splat as often as in the whole capture. Growth
slows down: what was not tried is taken to grow by the last rate over the number of the densification, which held for
runs with 10 to 97 of them (docs/scale.md).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import GradDensify, Recipe, Stage
from gs2d.core.splats import Splats
from gs2d.data import Scene, View
from gs2d.errors import Gs2dError
from gs2d.render.backends import Backend
from gs2d.training import events
from gs2d.training.trainer import Trainer

TRIED_SECONDS = 12.0
MAX_TRIED_GROWTH = 30.0  # times the start, from which nothing more is learned
COUNTED_SPLATS, COUNTED_VIEWS = 400, 200  # by which it is found how many photographs show a splat
UNSURE = 0.5  # of the growth (its logarithm) that was not tried, and
UNSURE_TRIED = 0.25  # of that which was: a few photographs are not all


@dataclass(frozen=True)
class Growth:
    """Splats at the end of densification over those at the start: least, expected, most."""

    least: float
    expected: float
    most: float


NONE = Growth(1.0, 1.0, 1.0)


def densifications(densify: GradDensify) -> int:
    """Return how often a stage densifies."""
    return sum(densify.densifies(i) for i in range(densify.every, densify.stop, densify.every))


def seen_fraction(splats: Splats, views: Sequence[View]) -> float:
    """Return which part of the photographs shows a splat, on average; 1 / their number at least."""
    rows = np.linspace(0, len(splats) - 1, min(len(splats), COUNTED_SPLATS)).astype(np.int64)
    places = splats.means.detach().cpu().double().numpy()[rows]
    chosen = [views[int(i)] for i in np.linspace(0, len(views) - 1, min(len(views), COUNTED_VIEWS))]
    found = []
    for view in chosen:
        pixels, depth = view.camera.project(places)
        inside = (pixels >= 0).all(axis=1) & (pixels < (view.camera.width, view.camera.height)).all(axis=1)
        found.append(float((inside & (depth > 0)).mean()))
    return max(float(np.mean(found)), 1 / len(views))


def shown_as_often(stage: Stage, densify: GradDensify, ratio: float) -> Stage:
    """Return a stage in which as many iterations lie between two densifications as ``ratio`` of those there were."""
    every = max(1, round(densify.every * ratio))
    start = round(densify.start * ratio)
    stop = start + every * (densifications(densify) + 2)
    changed = replace(densify, every=every, start=start, stop=stop, reset_every=0, reset_at=(), max_splats=None)
    return replace(stage, densify=changed, iterations=max(stage.iterations, stop))


def try_growth(part: Scene, recipe: Recipe, protocol: Protocol, backend: Backend, ratio: float) -> list[float]:
    """Return splats after each densification over those at the start, as far as seconds go.

    Parameters
    ----------
    part : Scene
        The photographs that are tried.
    recipe : Recipe
        Whose first stage densifies by gradients.
    ratio : float
        How much less often the whole capture shows a splat than the part does.
    """
    first, *_ = recipe.stages
    assert isinstance(first.densify, GradDensify)
    stage = shown_as_often(replace(first, downscale=1, halve_at=()), first.densify, ratio)
    counts: list[int] = []

    def listen(event: events.Event) -> None:
        if isinstance(event, events.Densified):
            counts.append(event.splats)

    try:
        trainer = Trainer(
            part,
            replace(recipe, stages=(stage,), removal=None),
            protocol,
            backend=backend,
            on_event=listen,
            progress_every=1,
        )
        trainer.enter(0)
        start, wanted, begun = len(trainer.splats), densifications(first.densify), time.perf_counter()
        while len(counts) < wanted and time.perf_counter() - begun < TRIED_SECONDS:
            trainer.step()
            if counts and counts[-1] > MAX_TRIED_GROWTH * start:
                break
    except Gs2dError:  # of which training itself will tell
        pass
    return [count / start for count in counts]


def extrapolated(tried: Sequence[float], wanted: int) -> Growth | None:
    """Return the growth after so many densifications of which the first were tried; None where that is too little.

    Parameters
    ----------
    tried : sequence of float
        Splats after each over those at the start.
    wanted : int
    """
    if wanted == 0:
        return NONE
    if not tried:
        return None
    done = len(tried)
    reached = math.log(max(tried[-1], 1e-3))
    steps = np.diff(np.log([1.0, *tried]))[-2:]  # one alone is uneven
    rate = max(float(steps.mean()), 0.0)
    rest = rate * sum(done / k for k in range(done + 1, wanted + 1))
    doubt = UNSURE_TRIED * abs(reached) + UNSURE * rest
    middle = reached + rest
    return Growth(*(math.exp(value) for value in (middle - doubt, middle, middle + doubt)))


def moved_away(splats: Splats, distance: float) -> Splats:
    """Return the splats, and as many that no photograph shows."""
    rows = splats.rows(torch.arange(len(splats)).repeat(2))
    means = rows.means.clone()
    means[len(splats) :] += distance
    return replace(rows, means=means)
