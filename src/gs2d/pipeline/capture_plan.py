"""What a capture will take: splats, memory, disk and hours on this machine, before anything is trained.

Some photographs from the middle of the capture are decoded, swept and trained on for seconds; the rest is arithmetic
with what was met in finished runs (docs/scale.md). All of it is told with bounds.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import GradDensify, Recipe
from gs2d.core.memory_limit import memory_budget
from gs2d.data import Scene
from gs2d.data.prepared import decoded_bytes
from gs2d.errors import DataError
from gs2d.pipeline.estimate import full_iterations
from gs2d.pipeline.events import duration
from gs2d.pipeline.growth import Growth
from gs2d.pipeline.memory import DECODING_BYTES, ITERATION_BYTES, MAX_DOWNSCALE
from gs2d.pipeline.photographs import fits
from gs2d.pipeline.probe import Probe, probe
from gs2d.render.backends import Backend
from gs2d.training.plane_sweep import sweep_downscale
from gs2d.training.robust import ends_part, looks_at_free_space

PROGRAM_BYTES = 384 << 20  # torch, the kernels, the scene
SPLAT_BYTES = 1200  # parameters, moments, gradients and what the rasterizer holds of a splat (docs/performance.md)
FUSION_BYTES = 220 << 20  # a slab, the surface of a default mesh and what cleans it: by ten runs (docs/scale.md)
PLACE_BYTES = 15_000  # of that for a place of the dense start, three pixels of what was swept, where it is less
CHECKPOINT_BYTES = 59 * 3 * 4  # of a splat; two checkpoints are kept
FILE_BYTES = 4 * 61 + 80 + 40  # of a splat: splats.ply, scene.html, the mesh
GROWTH = Growth(1.0, 4.0, 9.0)  # of splats in finished runs, where it cannot be tried
FIXED_SECONDS = 15  # to start, find the subject, write the page and the report
DOUBT = 1.5  # by which hours are known where the splats are


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
class CapturePlan:
    """What training on a capture takes.

    Attributes
    ----------
    photographs : int
    pixels : int
        Of all photographs, as files, and ``trained_pixels`` at the size of training.
    trained_pixels : int
    downscale : int
        As asked for, or the next at which an iteration fits.
    iterations : int
    start : int
        Splats that training starts from, about.
    splats : Range
        At the end.
    max_splats : int or None
        The budget of splats that fits in memory, where as many as may come would not.
    memory : Range
        Bytes.
    allowed : int or None
        Bytes of memory to keep to.
    prepared : bool
        Whether the photographs wait on the disk.
    disk : float
        Bytes in the run folder, and ``temporary`` in the temporary folder, for depth maps.
    temporary : float
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
    seconds: Range
    budget: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the plan for people."""
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


def plan_capture(
    scene: Scene, recipe: Recipe, protocol: Protocol, backend: Backend, *, downscale: int = 1, prepare: str = "auto"
) -> CapturePlan:
    """Plan the training of a scene, whose photographs are ``downscale`` times smaller than their files.

    Raises
    ------
    DataError
        What training starts from does not fit in memory at any downscale.
    Gs2dError
        The recipe cannot begin.
    """
    tried = probe(scene, recipe, protocol, backend)
    allowed, on_host = memory_budget(), backend.device == "cpu"
    largest = max(view.camera.width * view.camera.height for view in scene.views) * downscale**2
    chosen = fitting_downscale(largest, downscale, allowed, on_host=on_host)
    shrink = (downscale / chosen) ** 2
    trained = sum(view.camera.width * view.camera.height for view in scene.views) * shrink
    sparse = 0 if scene.points is None else len(scene.points)
    start = max(2, sparse if tried.start is None else tried.start)
    splats, budget = expected_splats(recipe, start, tried.growth), None
    prepared = prepare == "always" or (prepare == "auto" and not fits(scene))
    pictures = 0.0 if prepared else decoded_bytes(scene) * shrink
    fixed = PROGRAM_BYTES + pictures + largest / chosen**2 * ITERATION_BYTES * on_host + largest * DECODING_BYTES
    meshing = meshing_bytes(scene, recipe, tried.start, shrink)
    memory = _memory(fixed, meshing, splats)
    if allowed is not None and memory.most > allowed:
        budget = int((allowed - fixed - FUSION_BYTES) / SPLAT_BYTES)
        if budget < start:
            raise DataError(
                f"{len(scene.views):,} photographs start from about {rounded(start):,} splats, which need "
                f"{(fixed + FUSION_BYTES + start * SPLAT_BYTES) / 2**30:.2g} GiB, got "
                f"{allowed / 2**30:.2g} GiB to keep to; allow more --memory, or train on a part of the capture"
            )
        splats = Range(min(splats.least, budget), min(splats.expected, budget), min(splats.most, budget))
        memory = _memory(fixed, meshing, splats)
        budget = None if splats.most < budget else rounded(0.95 * budget)
    packed = trained * tried.packed if prepared else 0.0
    return CapturePlan(
        photographs=len(scene.views),
        pixels=sum(k.width * k.height for k in (view.file_intrinsics() for view in scene.views)),
        trained_pixels=int(trained),
        downscale=chosen,
        iterations=recipe.iterations,
        start=start,
        splats=splats,
        max_splats=budget,
        memory=memory,
        allowed=allowed,
        prepared=prepared,
        disk=packed + splats.expected * (2 * CHECKPOINT_BYTES + FILE_BYTES),
        temporary=trained * 8,
        seconds=_seconds(tried, recipe, scene, start, splats, shrink),
        budget=() if budget is None else budget_overrides(recipe, budget),
    )


def fitting_downscale(largest: int, downscale: int, allowed: int | None, *, on_host: bool) -> int:
    """Return the smallest downscale, not below the given one, at which an iteration takes half of what is allowed.

    Raises
    ------
    DataError
        There is none.
    """
    if allowed is None or not on_host:
        return downscale
    for factor in range(downscale, MAX_DOWNSCALE + 1):
        if PROGRAM_BYTES + largest * (ITERATION_BYTES / factor**2 + DECODING_BYTES) <= allowed:
            return factor
    raise DataError(
        f"photographs of up to {largest / 1e6:.3g} megapixels need {largest * DECODING_BYTES / 2**30:.2g} GiB to be "
        f"read, got {allowed / 2**30:.2g} GiB to keep to; allow more --memory, or shrink the files"
    )


def expected_splats(recipe: Recipe, start: int, growth: Growth | None = None) -> Range:
    """Return the splats at the end of a recipe that starts from so many, with the growth that was tried."""
    densifiers = [stage.densify for stage in recipe.stages if stage.densify is not None]
    growth = (growth or GROWTH) if densifiers else Growth(1.0, 1.0, 1.0)
    grown = [start * factor for factor in (growth.least, growth.expected, growth.most)]
    budgets = [getattr(densify, "max_splats", None) for densify in densifiers]
    most = max((budget for budget in budgets if budget is not None), default=None)
    least, expected, largest = (value if most is None else min(value, max(most, start)) for value in grown)
    return Range(least, expected, largest)


def meshing_bytes(scene: Scene, recipe: Recipe, start: int | None, shrink: float = 1.0) -> float:
    """Return what meshing takes: it goes with the pixels that show surface, up to a slab of the volume.

    A dense start has a place for about three such pixels of the photographs as they were swept; sparse points tell
    nothing of the surface.
    """
    if start is None or recipe.dense_start is None:
        return FUSION_BYTES
    pixels = sweep_downscale(scene, recipe.dense_start) ** 2 * shrink
    return min(FUSION_BYTES, start * PLACE_BYTES * pixels)


def _memory(fixed: float, meshing: float, splats: Range) -> Range:
    """Return bytes; what the mesh takes comes when training has given its gradients back, with as much again."""
    least, expected, most = (fixed + count * SPLAT_BYTES for count in asdict(splats).values())
    return Range(least + meshing, expected + meshing, most + FUSION_BYTES)


def _seconds(tried: Probe, recipe: Recipe, scene: Scene, start: int, splats: Range, shrink: float) -> Range:
    """Return seconds of everything: each iteration, and each look, by how many splats there are by then."""
    threads, views = max(1, torch.get_num_threads()), len(scene.train)
    swept = 0 if recipe.dense_start is None else min(views, recipe.dense_start.max_views)
    fixed = FIXED_SECONDS + len(scene.views) * tried.decode * 2 / min(threads, 2)
    fixed += swept * (tried.sweep + tried.fit * start)
    iterations = full_iterations(recipe) + 1.2 * len(scene.views)  # scored, fused
    free_looks, seen_looks = looks_of(recipe)
    found = []
    for count in asdict(splats).values():
        mean = (start + 3 * count) / 4  # most splats come in the first half
        trained = tried.iteration.of(mean, tried.shown) * shrink * iterations
        looked = swept * free_looks * tried.free_look.of(mean, tried.shown)
        looked += views * seen_looks * tried.seen_look.of(mean, tried.shown)
        found.append(fixed + trained + looked)
    return Range(found[0] / DOUBT, found[1], found[2] * DOUBT)


def looks_of(recipe: Recipe) -> tuple[int, int]:
    """Return how often robust training looks at free space and at the seen area, at all photographs each time."""
    each = [(stage, i) for stage in recipe.stages for i in range(1, stage.iterations + 1)]
    return sum(looks_at_free_space(recipe, *at) for at in each), sum(ends_part(recipe, *at) for at in each)
