"""A few photographs of a capture tried for seconds: what is started from, and what iterations and looks take."""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from PIL import Image

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import GradDensify, Recipe
from gs2d.core.splats import Splats
from gs2d.data import Scene, View
from gs2d.data.scene import PointCloud
from gs2d.errors import DataError
from gs2d.pipeline.estimate import seconds_of
from gs2d.pipeline.growth import Growth, densifications, extrapolated, moved_away, seen_fraction, try_growth
from gs2d.render.backends import Backend
from gs2d.training.free_space import FreeSpaceMaps
from gs2d.training.plane_sweep import Sweep, start_points, sweep_views
from gs2d.training.seen_area import mostly_unseen
from gs2d.training.start_fit import fit_start
from gs2d.training.trainer import Trainer, raster_settings

PROBED_VIEWS, DECODED_VIEWS = 12, 4
CROWD = 4  # times as many splats, by which it is tried what one more takes
FAR = 1000.0  # extents, where no photograph shows a splat


@dataclass(frozen=True)
class Cost:
    """Seconds of one thing without splats, and of each splat more that the photograph shows, and does not show."""

    base: float
    seen: float
    unseen: float

    def of(self, splats: float, shown: float) -> float:
        """Return seconds with so many splats, of which the photograph shows a part."""
        return self.base + splats * (self.seen * shown + self.unseen * (1 - shown))


FREE = Cost(0.0, 0.0, 0.0)


def cost_of(splats: Splats, extent: float, seconds: Callable[[Splats], float]) -> Cost:
    """Return what something costs by its seconds with splats, with four times as many, and with as many unseen."""
    once, crowd, beside = (seconds(some) for some in (splats, crowded(splats), moved_away(splats, FAR * extent)))
    seen = max(crowd - once, 0.0) / (len(splats) * (CROWD - 1))
    unseen = min(max(beside - once, 0.0) / len(splats), seen)
    return Cost(max(once - seen * len(splats), 0.2 * once), seen, unseen)


@dataclass(frozen=True)
class Probe:
    """What seconds of trying told.

    Attributes
    ----------
    start : int or None
        Splats that training starts from; None: from the sparse points.
    sweep, decode : float
        Seconds of a photograph.
    packed : float
        Bytes of a prepared pixel.
    iteration : Cost
    free_look, seen_look : Cost
        Of a look at free space and at the seen area of all splats in one photograph.
    fit : float
        Seconds to fit a splat of the start to one photograph.
    shown : float
        How much less often the whole capture shows a splat than the photographs that were tried do.
    growth : Growth or None
        Splats at the end over those at the start; None: it was not to be tried.
    """

    start: int | None
    sweep: float
    decode: float
    packed: float
    iteration: Cost
    free_look: Cost
    seen_look: Cost
    fit: float
    shown: float
    growth: Growth | None


def middle_views(views: Sequence[View], count: int) -> list[View]:
    """Return so many views that stand nearest to the one in the middle of all."""
    centers = np.array([view.camera.center for view in views])
    middle = centers[np.argmin(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))]
    return [views[i] for i in np.sort(np.argsort(np.linalg.norm(centers - middle, axis=1), kind="stable")[:count])]


def swept_views(scene: Scene, recipe: Recipe) -> list[View]:
    """Return the training views that a dense start chooses to sweep: all, or as many as it takes of many."""
    views, most = list(scene.train), len(scene.train)
    if recipe.dense_start is not None:
        most = min(most, recipe.dense_start.max_views)
    return [views[int(i)] for i in np.unique(np.linspace(0, len(views) - 1, most).round())]


def dense_start_of(part: Scene, scene: Scene, recipe: Recipe) -> tuple[Sweep | None, int | None]:
    """Return the sweep of a part, and how many splats the dense start of the whole makes; None: none can be made.

    The part's are taken as many times as the swept photographs show sparse points for one that the part shows; the
    points that none of them shows come on top.
    """
    assert recipe.dense_start is not None
    cloud, times, rest = None, len(scene.train) / len(part.train), 0
    if scene.points is not None and (observed := scene.observed()) is not None:
        here, swept, everywhere = (
            np.unique(np.concatenate([observed.seen.get(view.name, np.zeros(0, np.int32)) for view in views]))
            for views in (part.train, swept_views(scene, recipe), scene.train)
        )
        if len(here):
            cloud, times = PointCloud(observed.points[here]), len(swept) / len(here)
            rest = len(everywhere) - len(swept)
    try:
        sweep = sweep_views(part, recipe.dense_start)
        points = start_points(replace(part, points=cloud), sweep, recipe.dense_start)
    except DataError:
        return None, None  # training itself says what is done then
    return sweep, rest + round(times * len(points))


def probe(scene: Scene, recipe: Recipe, protocol: Protocol, backend: Backend) -> Probe:
    """Try a few photographs from the middle of the capture: seconds.

    Raises
    ------
    Gs2dError
        The recipe cannot begin on them.
    """
    views = middle_views(scene.train, PROBED_VIEWS)
    begun = time.perf_counter()
    pictures = [view.image() for view in views[:DECODED_VIEWS]]
    decode = (time.perf_counter() - begun) / len(pictures)
    sizes = []
    for picture in pictures:
        png = io.BytesIO()
        Image.fromarray(picture).save(png, format="PNG", compress_level=1)
        sizes.append(png.tell() / (picture.shape[0] * picture.shape[1]))
    part = replace(scene, train=tuple(views), test=())
    start, swept, sweep = None, 0.0, None
    if recipe.dense_start is not None:
        begun = time.perf_counter()
        sweep, start = dense_start_of(part, scene, recipe)
        swept = (time.perf_counter() - begun) / len(views)
    splats, iteration = _iteration(part, recipe, protocol, backend)
    free_look, seen_look, fit = _looks(splats, part, recipe, protocol, backend, sweep)
    shown = min(1.0, seen_fraction(splats, scene.train) / seen_fraction(splats, part.train))
    growth, densify = None, recipe.stages[0].densify
    if isinstance(densify, GradDensify):
        growth = extrapolated(try_growth(part, recipe, protocol, backend, shown), densifications(densify))
    packed = float(np.mean(sizes))
    return Probe(start, swept, decode, packed, iteration, free_look, seen_look, fit, shown, growth)


def _iteration(part: Scene, recipe: Recipe, protocol: Protocol, backend: Backend) -> tuple[Splats, Cost]:
    """Return splats on a part of a capture, and what an iteration costs there."""
    first, *rest = recipe.stages
    bare = replace(
        recipe,
        stages=(replace(first, downscale=1, halve_at=()), *rest),
        dense_start=None,
        removal=None,
    )
    start = Trainer(part, bare, protocol, backend=backend, progress_every=1).splats.to("cpu")

    def seconds(splats: Splats) -> float:
        trainer = Trainer(part, bare, protocol, backend=backend, init=splats, progress_every=1)
        trainer.enter(0)
        taken = seconds_of(trainer, first.iterations)
        if taken is None:
            raise DataError("too few iterations to measure; plan a longer schedule")
        return taken

    return start, cost_of(start, part.extent, seconds)


def _looks(
    splats: Splats, part: Scene, recipe: Recipe, protocol: Protocol, backend: Backend, sweep: Sweep | None
) -> tuple[Cost, Cost, float]:
    """Return what robust training's looks at one photograph cost, and fitting one splat of the start to one."""
    count, free_look, seen_look, fit = len(part.train), FREE, FREE, 0.0
    if sweep is not None and recipe.removal is not None:
        maps = FreeSpaceMaps(sweep)
        maps.move_to(backend.device)
        free_look = cost_of(splats, part.extent, lambda some: _timed(maps.against, some.to(backend.device)) / count)
    if recipe.removal is not None:
        cameras = [view.camera for view in part.train]
        raster = raster_settings(protocol, part.extent, recipe.sh_degree)
        seen_look = cost_of(
            splats,
            part.extent,
            lambda some: (
                _timed(
                    partial(mostly_unseen, cameras=cameras, raster=raster, backend=backend),
                    some.to(backend.device),
                )
                / count
            ),
        )
    start = recipe.dense_start
    if sweep is not None and start is not None and start.fit is not None:
        fit = _timed(lambda some: fit_start(some, sweep, start), splats) / (len(sweep.views) * len(splats))
    return free_look, seen_look, fit


def _timed(task: Callable[[Splats], object], splats: Splats) -> float:
    begun = time.perf_counter()
    task(splats)
    return time.perf_counter() - begun


def crowded(splats: Splats, times: int = CROWD) -> Splats:
    """Return so many times the splats on the same surface: each has as much less area."""
    generator = torch.Generator().manual_seed(0)
    rows = splats.rows(torch.arange(len(splats)).repeat_interleave(times))
    shift = torch.randn(rows.means.shape, generator=generator, dtype=rows.means.dtype)
    return replace(
        rows,
        means=rows.means + shift * rows.scales.mean(dim=1, keepdim=True) / 2,
        log_scales=rows.log_scales - math.log(times) / 2,
    )
