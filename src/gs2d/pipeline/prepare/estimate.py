"""Estimate what a training takes, by arithmetic from the capture and the recipe: splats, memory, disk and time.

Nothing is trained. The number of splats is the least certain: it depends on what the photographs show. The constants
were compared with ten finished runs (docs/notebook/scale.md); each estimate has bounds.

Work is counted in units: a unit is the time in which the rasterizer renders one pixel of a small test scene, forwards
and backwards. ``rasterizer_speed`` measures it on the machine that trains, in less than a second.
"""

from __future__ import annotations

import itertools
import math
import shlex
import time
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np
import torch

from gs2d.config.densify import Densify
from gs2d.config.recipe import GradDensify, Recipe
from gs2d.config.robust import DenseStart
from gs2d.core.camera import Camera
from gs2d.core.memory_limit import memory_budget
from gs2d.core.splats import Splats
from gs2d.core.text import duration
from gs2d.data import Scene
from gs2d.data.prepared import decoded_bytes, packed_bytes
from gs2d.errors import DataError
from gs2d.pipeline.prepare.limits import DECODING_BYTES, ITERATION_BYTES
from gs2d.pipeline.prepare.photographs import fits
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from gs2d.training.plane_sweep import sweep_downscale
from gs2d.training.robust import MAX_WITNESSES, ends_part, looks_at_free_space

# Memory and disk, bytes.
PROGRAM_BYTES = 384 << 20  # torch, the kernels, the scene
SPLAT_BYTES = 1200  # a splat's parameters, moments, gradients and rasterizer state (docs/notebook/performance.md)
FUSION_BYTES = 220 << 20  # the mesh: a slab of the volume and its surface; comes when the gradients are gone
CHECKPOINT_BYTES = 59 * 3 * 4  # of a splat; two checkpoints are kept
FILE_BYTES = 4 * 61 + 80 + 40  # of a splat: splats.ply, scene.html, the mesh
# Number of splats at the end over that at the start: least, expected, most, in the finished runs.
GROWTH = (0.5, 3.0, 9.0)
DOUBLING = 2.0  # a densification at most doubles the splats
# Work, in units, fitted to trainings and to parts of them on two cores.
PIXEL_WORK = 1.2  # of an iteration, for each pixel: rendering, losses and their gradients
SPLAT_WORK = 0.8  # of an iteration, for each splat: projection, sorting, Adam
SWEEP_WORK = 8.0  # of the dense start, for each pixel of a swept photograph
LOOK_WORK = 0.4  # of a look at free space, for each splat and swept photograph
SEEN_WORK = 2.0  # of a look at what is mostly unseen, for each splat and training photograph
TRIAL_ITERATIONS = 50  # that a trial of removal with all its witnesses takes the time of (training/robust.py)
TRIALS_BETWEEN = 8  # beside those at the ends of parts: looks with enough new proposals for a trial
FINISH_ITERATIONS = 5  # for each photograph after training: it is scored, and its depth is rendered and fused
FIXED_SECONDS = 15  # to start, find the subject, extract the mesh, write page and report
DOUBT = 2.0  # factor of the bounds of time: other work on the machine, and scenes that differ
# The test scene of ``rasterizer_speed``: its side doubles until it takes so many seconds.
SIDES, ENOUGH_SECONDS = (16, 32, 64, 128, 256, 512, 1024), 0.03


@dataclass(frozen=True)
class Range:
    """A figure: at least, expected, at most."""

    least: float
    expected: float
    most: float

    def scaled(self, factor: float) -> Range:
        """Return all three times a factor."""
        return Range(self.least * factor, self.expected * factor, self.most * factor)


@dataclass(frozen=True)
class Estimate:
    """What training on a capture takes.

    Attributes
    ----------
    photographs : int
    pixels : int
        Of all photographs, as files, and ``trained_pixels`` at the size of training.
    trained_pixels : int
    downscale : int
    iterations : int
    start : int
        Splats that training starts from.
    splats : Range
        At the end.
    max_splats : int or None
        Largest number of splats that fits into memory; None: as many as may come do.
    memory : Range
        Bytes.
    allowed : int or None
        Bytes of memory to keep to.
    prepared : bool
        Whether photographs are kept on the disk, undistorted and shrunk.
    disk : float
        Bytes in the run folder, and ``temporary`` in the temporary folder, for depth maps.
    temporary : float
    training : Range
        Seconds of training alone; ``seconds`` of everything.
    seconds : Range
    budget : tuple of str
        Overrides that keep the recipe to ``max_splats``.
    """

    photographs: int
    pixels: int
    trained_pixels: int
    downscale: int
    iterations: int
    start: int
    splats: Range
    max_splats: int | None
    memory: Range
    allowed: int | None
    prepared: bool
    disk: float
    temporary: float
    training: Range
    seconds: Range
    budget: tuple[str, ...] = ()

    def line(self) -> str:
        """Return time and memory in one line, as it is told before training."""
        training, memory = self.training, self.memory.scaled(2.0**-30)
        return (
            f"training will take about {duration(training.least)} to {duration(training.most)} for {self.iterations:,} "
            f"iterations and {memory.least:.2g} to {memory.most:.2g} GiB of memory"
        )

    def lines(self) -> list[str]:
        """Return the estimate for people."""
        shrunk = f"{self.trained_pixels / 1e6:.3g} as they are trained on (--downscale {self.downscale}), "
        where = "prepared on the disk" if self.prepared else "in memory"
        of = "" if self.allowed is None else f" of {self.allowed / 2**30:.3g} GiB allowed"
        limited = shlex.join(set_words(self.budget)) or "more --memory"  # not every densifier takes a limit
        budget = "" if self.max_splats is None else f"; only with {limited}"
        memory, splats, seconds = self.memory.scaled(2.0**-30), self.splats, self.seconds
        return [
            f"photographs: {self.photographs:,} with {self.pixels / 1e6:.3g} megapixels together, "
            f"{shrunk if self.downscale > 1 else ''}{where}",
            f"splats: {rounded(splats.expected):,} ({rounded(splats.least):,} to {rounded(splats.most):,}), from "
            f"{rounded(self.start):,}{budget}",
            f"memory: {memory.expected:.2g} GiB ({memory.least:.2g} to {memory.most:.2g}){of}",
            f"disk: {self.disk / 2**30:.2g} GiB in the run, {self.temporary / 2**30:.2g} GiB for a while in the "
            "temporary folder",
            f"time: {duration(seconds.expected)} ({duration(seconds.least)} to {duration(seconds.most)}), "
            f"{self.iterations:,} iterations, mesh and report",
        ]


def estimate(
    scene: Scene,
    recipe: Recipe,
    backend: Backend,
    *,
    downscale: int = 1,
    prepare: str = "auto",
    start: int | None = None,
) -> Estimate:
    """Estimate the training of a scene, whose photographs are ``downscale`` times smaller than their files.

    Parameters
    ----------
    scene : Scene
    recipe : Recipe
    backend : Backend
    downscale : int
    prepare : str
        "auto", "always" or "never": whether photographs are kept on the disk.
    start : int, optional
        Splats that training starts from, if they are known.

    Raises
    ------
    DataError
        What training starts from does not fit into memory.
    """
    allowed = memory_budget()
    start = start_of(scene, recipe) if start is None else start
    splats, budget = expected_splats(recipe, start), None
    prepared = prepare == "always" or (prepare == "auto" and not fits(scene))
    largest = max(view.camera.width * view.camera.height for view in scene.views)
    fixed = PROGRAM_BYTES + largest * (ITERATION_BYTES * backend.on_host + DECODING_BYTES * downscale**2)
    fixed += 0 if prepared else decoded_bytes(scene)
    memory = _memory(fixed, splats)
    if allowed is not None and memory.most > allowed:
        budget = int((allowed - fixed - FUSION_BYTES) / SPLAT_BYTES)
        if budget < start:
            raise DataError(
                f"{len(scene.views):,} photographs start from about {rounded(start):,} splats, which need "
                f"{(fixed + FUSION_BYTES + start * SPLAT_BYTES) / 2**30:.2g} GiB, got {allowed / 2**30:.2g} GiB to "
                "keep to; allow more --memory, or train on a part of the capture"
            )
        splats = Range(min(splats.least, budget), min(splats.expected, budget), min(splats.most, budget))
        memory = _memory(fixed, splats)
        budget = None if splats.most < budget else rounded(0.95 * budget)
    trained = sum(view.camera.width * view.camera.height for view in scene.views)
    packed = packed_bytes(scene.views) if prepared else 0.0
    training, seconds = _seconds(scene, recipe, start, splats, rasterizer_speed(backend))
    return Estimate(
        photographs=len(scene.views),
        pixels=sum(k.width * k.height for k in (view.file_intrinsics() for view in scene.views)),
        trained_pixels=trained,
        downscale=downscale,
        iterations=recipe.iterations,
        start=start,
        splats=splats,
        max_splats=budget,
        memory=memory,
        allowed=allowed,
        prepared=prepared,
        disk=packed + splats.expected * (2 * CHECKPOINT_BYTES + FILE_BYTES),
        temporary=trained * 8,
        training=training,
        seconds=seconds,
        budget=() if budget is None else budget_overrides(recipe, budget),
    )


# -- splats and memory -------------------------------------------------------------------------------------------------
def start_of(scene: Scene, recipe: Recipe) -> int:
    """Return the number of splats that training starts from, about.

    A dense start has a splat for a cell of a swept photograph. Photographs overlap: V of them have as many new cells as
    the square root of V that do not. About half of the sparse points lie apart from those. It holds within a factor of
    1.7 for seven of eight captures, and 3.4 for the other.
    """
    dense, sparse = recipe.dense_start, 0 if scene.points is None else len(scene.points)
    if dense is None:
        return max(2, recipe.init_points if scene.points is None else sparse)
    cells = _mean_pixels(scene) / sweep_downscale(scene, dense) ** 2 / dense.cell**2
    return max(2, round(cells * math.sqrt(min(len(scene.train), dense.max_views)) + sparse / 2))


def expected_splats(recipe: Recipe, start: int) -> Range:
    """Return the splats at the end of a recipe that starts from so many."""
    densifiers = [stage.densify for stage in recipe.stages if stage.densify is not None]
    times = 0.0
    for densify in densifiers:
        if isinstance(densify, GradDensify):
            times += sum(map(densify.densifies, range(densify.stop)))
        else:  # a registered densifier decides by itself how often
            times = math.inf
    if times == 0:
        return Range(start, start, start)
    least, expected, most = (start * min(growth, DOUBLING ** min(times, 10)) for growth in GROWTH)
    limits = [limit for limit in map(limit_of, densifiers) if limit is not None]
    if limits:
        least, expected, most = (min(count, max(start, *limits)) for count in (least, expected, most))
    return Range(least, expected, most)


def limit_of(densify: GradDensify | Densify) -> int | None:
    """Return the number of splats beyond which a densifier adds none; None: it has no limit."""
    limit = densify.max_splats if isinstance(densify, GradDensify) else densify.options.get("max_splats")
    return None if limit is None else int(limit)


def budget_overrides(recipe: Recipe, splats: int) -> tuple[str, ...]:
    """Return the overrides that limit the splats of a recipe: one for each stage whose densifier takes a limit."""
    found = []
    for stage in recipe.stages:
        if isinstance(stage.densify, GradDensify):
            found.append(f"{stage.name}.densify.max_splats={splats}")
        elif stage.densify is not None and "max_splats" in stage.densify.options:
            found.append(f"{stage.name}.densify.options.max_splats={splats}")
    return tuple(found)


def set_words(overrides: Sequence[str]) -> list[str]:
    """Return overrides as words of a command line."""
    return [word for override in overrides for word in ("--set", override)]


def rounded(number: float) -> int:
    """Return a number to two digits."""
    return 0 if number < 1 else int(round(number, 1 - math.floor(math.log10(number))))


def _mean_pixels(scene: Scene) -> float:
    """Return the mean number of pixels of a training photograph."""
    return float(np.mean([view.camera.width * view.camera.height for view in scene.train]))


def _memory(fixed: float, splats: Range) -> Range:
    """Return bytes; a small surface takes half of what a mesh may."""
    least, expected, most = (fixed + FUSION_BYTES + count * SPLAT_BYTES for count in astuple(splats))
    return Range(least - FUSION_BYTES / 2, expected, most)


# -- time --------------------------------------------------------------------------------------------------------------
def iteration_costs(recipe: Recipe) -> tuple[tuple[int, float], ...]:
    """Return runs of iterations of a recipe, with the fraction of pixels that its photographs have there."""
    each = (1 / stage.downscale_at(i) ** 2 for stage in recipe.stages for i in range(1, stage.iterations + 1))
    return tuple((sum(1 for _ in run), cost) for cost, run in itertools.groupby(each))


def full_iterations(recipe: Recipe) -> float:
    """Return the iterations of a recipe, each counted as the fraction of pixels that its photographs have."""
    return sum(count * cost for count, cost in iteration_costs(recipe))


def training_work(scene: Scene, recipe: Recipe, splats: float) -> float:
    """Return the work of all iterations with so many splats on average, and of the removal of floaters, in units."""
    work = PIXEL_WORK * _mean_pixels(scene) * full_iterations(recipe) + SPLAT_WORK * splats * recipe.iterations
    if recipe.removal is None:
        return work
    each = [(stage, i) for stage in recipe.stages for i in range(1, stage.iterations + 1)]
    looks = sum(looks_at_free_space(recipe, *at) for at in each)
    parts = sum(ends_part(recipe, *at) for at in each)
    views, swept = len(scene.train), min(len(scene.train), (recipe.dense_start or DenseStart()).max_views)
    trials = (parts + min(looks, TRIALS_BETWEEN)) * min(1.0, views / MAX_WITNESSES)
    work += trials * TRIAL_ITERATIONS * _iteration_work(scene, splats)
    return work + splats * (LOOK_WORK * looks * swept + SEEN_WORK * parts * views)


def _iteration_work(scene: Scene, splats: float) -> float:
    """Return the work of an iteration on photographs of full size, in units."""
    return PIXEL_WORK * _mean_pixels(scene) + SPLAT_WORK * splats


def _seconds(scene: Scene, recipe: Recipe, start: int, splats: Range, unit: float) -> tuple[Range, Range]:
    """Return the seconds of training, and of everything: the dense start before and the mesh after it."""
    before = 0.0
    if (dense := recipe.dense_start) is not None:
        swept = min(len(scene.train), dense.max_views)
        before = SWEEP_WORK * swept * _mean_pixels(scene) / sweep_downscale(scene, dense) ** 2
    training, whole = [], []
    for count, doubt in zip(astuple(splats), (1 / DOUBT, 1.0, DOUBT), strict=True):
        trained = training_work(scene, recipe, (start + 3 * count) / 4)  # most splats are added in the first half
        after = FINISH_ITERATIONS * len(scene.views) * _iteration_work(scene, count)
        training.append(trained * unit * doubt)
        whole.append((FIXED_SECONDS + (before + trained + after) * unit) * doubt)
    return Range(*training), Range(*whole)


def rasterizer_speed(backend: Backend) -> float:
    """Measure a unit of work, seconds: rendering, forwards and backwards, of a pixel of random splats.

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
        taken = []
        for _ in range(2):  # the first run may compile or allocate
            begun = time.perf_counter()
            rasterize(splats, camera, RasterSettings(), backend=backend).color.sum().backward()
            splats.means.grad.sum().item()  # type: ignore[union-attr]  # waits for a GPU
            taken.append(time.perf_counter() - begun)
        seconds = min(taken)
        if seconds > ENOUGH_SECONDS:
            break
    return seconds / side**2
