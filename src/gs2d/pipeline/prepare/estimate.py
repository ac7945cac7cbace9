"""Estimate time and memory of a training by arithmetic from the capture and the recipe.

The number of splats is the least certain: it depends on what the photographs show. The constants were compared with
ten finished runs (docs/notebook/scale.md). Work is counted in units of the time in which the rasterizer renders one
pixel of a small test scene, forwards and backwards; ``rasterizer_speed`` measures that time.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from gs2d.config.densify import Densify
from gs2d.config.recipe import GradDensify, Recipe
from gs2d.core.camera import Camera
from gs2d.core.memory_limit import memory_budget
from gs2d.core.splats import Splats
from gs2d.core.text import duration
from gs2d.data import Scene
from gs2d.errors import DataError
from gs2d.pipeline.prepare.limits import DECODING_BYTES, ITERATION_BYTES
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from gs2d.training.start.plane_sweep import MAX_VIEWS, sweep_downscale

# Bytes
PROGRAM_BYTES = 384 << 20  # torch, the kernels, the scene
SPLAT_BYTES = 1200  # parameters, moments, gradients and rasterizer state of a splat (docs/notebook/performance.md)
FUSION_BYTES = 220 << 20  # a slab of the volume and its surface, after the gradients are freed
GROWTH = (0.5, 3.0, 9.0)  # final over initial number of splats in the finished runs: least, expected, most
# Work, in units
PIXEL_WORK = 1.2  # of an iteration, per pixel: rendering, losses, gradients
SPLAT_WORK = 0.8  # of an iteration, per splat: projection, sorting, Adam
SWEEP_WORK = 8.0  # of the dense start, per pixel of a swept photograph
REMOVAL_WORK = (30.0, 0.006)  # of floater removal, per splat and swept photograph: fixed, and per iteration
FINISH_ITERATIONS = 5  # per photograph after training: scoring, rendering and fusing depth
FIXED_SECONDS = 15  # start, subject, mesh extraction, page, report
UNCERTAINTY = 2.0  # factor of the bounds of time
SIDES, ENOUGH_SECONDS = (16, 32, 64, 128, 256, 512, 1024), 0.03  # of the test scene: the side doubles until it is slow


class Range(NamedTuple):
    """Least, expected and most."""

    least: float
    expected: float
    most: float


@dataclass(frozen=True)
class Estimate:
    """What training on a capture needs."""

    start: int  # initial splats
    max_splats: int | None  # the largest number that fits into memory, where that limits them
    memory: Range  # bytes
    seconds: Range  # of the whole run

    def line(self) -> str:
        """Return time and memory in one line."""
        limit = ""
        if self.max_splats is not None:
            limit = f"; more than {self.max_splats:,} splats do not fit (--set STAGE.densify.max_splats limits them)"
        return (
            f"the run will take about {duration(self.seconds.least)} to {duration(self.seconds.most)} and "
            f"{self.memory.least / 2**30:.2g} to {self.memory.most / 2**30:.2g} GiB of memory{limit}"
        )


def estimate(
    scene: Scene, recipe: Recipe, backend: Backend, *, downscale: int = 1, start: int | None = None
) -> Estimate:
    """Estimate the training of a scene.

    ``downscale`` is the factor by which the photographs are smaller than their files, ``start`` the initial number of
    splats, if available. Raises DataError if the initial splats do not fit into memory.
    """
    allowed = memory_budget()
    start = initial_splats(scene, recipe) if start is None else start
    splats, budget = expected_splats(recipe, start), None
    sizes = [view.camera.width * view.camera.height for view in scene.views]
    fixed = PROGRAM_BYTES + max(sizes) * (ITERATION_BYTES * backend.on_host + DECODING_BYTES * downscale**2)
    fixed += FUSION_BYTES + min(3 * sum(sizes), *(view.cache.max_bytes for view in scene.views))
    if allowed is not None and fixed + splats.most * SPLAT_BYTES > allowed:
        budget = int((allowed - fixed) / SPLAT_BYTES)
        if budget < start:
            raise DataError(
                f"{len(scene.views):,} photographs start with about {rounded(start):,} splats, which need "
                f"{(fixed + start * SPLAT_BYTES) / 2**30:.2g} GiB, got {allowed / 2**30:.2g} GiB; allow more --memory, "
                "or train on a part of the capture"
            )
        splats = Range(*(min(count, budget) for count in splats))
        budget = None if splats.most < budget else rounded(0.95 * budget)
    memory = Range(*(fixed + count * SPLAT_BYTES for count in splats))
    memory = memory._replace(least=memory.least - FUSION_BYTES / 2)  # a small surface needs half
    return Estimate(start, budget, memory, _seconds(scene, recipe, start, splats, rasterizer_speed(backend)))


# -- splats ------------------------------------------------------------------------------------------------------------
def initial_splats(scene: Scene, recipe: Recipe) -> int:
    """Estimate the number of splats that training starts with, to a factor of two for most captures.

    A dense start has one splat per cell of a swept photograph. V overlapping photographs have as many new cells as
    sqrt(V) photographs that do not overlap. About half of the sparse points are apart from those.
    """
    dense, sparse = recipe.dense_start, 0 if scene.points is None else len(scene.points)
    if dense is None:
        return max(2, recipe.init_points if scene.points is None else sparse)
    cells = _mean_pixels(scene) / sweep_downscale(scene, dense) ** 2 / dense.cell**2
    return max(2, round(cells * math.sqrt(min(len(scene.train), MAX_VIEWS)) + sparse / 2))


def expected_splats(recipe: Recipe, start: int) -> Range:
    """Estimate the final number of splats of a recipe that starts with ``start`` splats."""
    densifiers = [stage.densify for stage in recipe.stages if stage.densify is not None]
    if not densifiers:
        return Range(start, start, start)
    limits = [limit for limit in map(limit_of, densifiers) if limit is not None]
    most = max(start, *limits) if limits else math.inf
    return Range(*(min(start * growth, most) for growth in GROWTH))


def limit_of(densify: GradDensify | Densify) -> int | None:
    """Return the number of splats beyond which a densifier adds none; None: no limit."""
    limit = densify.max_splats if isinstance(densify, GradDensify) else densify.options.get("max_splats")
    return None if limit is None else int(limit)


def rounded(number: float) -> int:
    """Round a number to two digits."""
    return 0 if number < 1 else int(round(number, 1 - math.floor(math.log10(number))))


def _mean_pixels(scene: Scene) -> float:
    return float(np.mean([view.camera.width * view.camera.height for view in scene.train]))


# -- time --------------------------------------------------------------------------------------------------------------
def _seconds(scene: Scene, recipe: Recipe, start: int, splats: Range, unit: float) -> Range:
    """Estimate the seconds of a run; ``unit`` is the result of :func:`rasterizer_speed`."""
    pixels, dense = _mean_pixels(scene), recipe.dense_start
    swept = min(len(scene.train), MAX_VIEWS)
    before = 0.0 if dense is None else SWEEP_WORK * swept * pixels / sweep_downscale(scene, dense) ** 2
    seconds = []
    for final, factor in zip(splats, (1 / UNCERTAINTY, 1.0, UNCERTAINTY), strict=True):
        count = (start + 3 * final) / 4  # most splats are added in the first half
        work = before + (PIXEL_WORK * pixels + SPLAT_WORK * count) * recipe.iterations
        if recipe.removal is not None:
            work += (REMOVAL_WORK[0] + REMOVAL_WORK[1] * recipe.iterations) * count * swept
        work += FINISH_ITERATIONS * len(scene.views) * (PIXEL_WORK * pixels + SPLAT_WORK * final)
        seconds.append((FIXED_SECONDS + work * unit) * factor)
    return Range(*seconds)


def rasterizer_speed(backend: Backend) -> float:
    """Measure a unit of work in seconds: a pixel of random splats, rendered forwards and backwards.

    There is a splat for four pixels, with a standard deviation of 1.5 px.
    """
    seconds, side, generator = 0.0, SIDES[0], torch.Generator().manual_seed(0)
    for side in SIDES:
        count = side * side // 4
        start = Splats(
            means=torch.rand(count, 3, generator=generator) + torch.tensor([-0.5, -0.5, 1.0]),
            quats=torch.randn(count, 4, generator=generator),
            log_scales=torch.full((count, 2), math.log(1.5 / side)),
            opacity_logits=torch.zeros(count),
            sh0=torch.rand(count, 1, 3, generator=generator),
            shN=torch.zeros(count, 15, 3),
        ).to(backend.device)
        splats = Splats(**{name: tensor.requires_grad_() for name, tensor in start.items()})
        camera = Camera(side, side, float(side), float(side), side / 2, side / 2, np.eye(4))
        times = []
        for _ in range(5):  # the first may compile or allocate; a busy machine interrupts others
            begun = time.perf_counter()
            rasterize(splats, camera, RasterSettings(), backend=backend).color.sum().backward()
            splats.means.grad.sum().item()  # type: ignore[union-attr]  # waits for a GPU
            times.append(time.perf_counter() - begun)
        seconds = min(times)
        if seconds > ENOUGH_SECONDS:
            break
    return seconds / side**2
