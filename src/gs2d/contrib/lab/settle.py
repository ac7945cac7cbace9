"""Resolve the settings that all blocks share, before training: recipe, protocol, capture and grid."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.config.densify import Densify
from gs2d.config.recipe import ALL, GradDensify, LearningRates, Recipe, validate
from gs2d.config.schedule import longer_steps, scale_schedule
from gs2d.config.serialize import to_json
from gs2d.contrib.lab.cells import spread_of
from gs2d.contrib.lab.partition import Partition, grid_for
from gs2d.contrib.lab.partition import to_json as partition_json
from gs2d.contrib.lab.split import BlockOfSplit
from gs2d.core.memory_limit import memory_budget
from gs2d.core.text import name_bytes
from gs2d.data import Scene
from gs2d.errors import DataError, RecipeError
from gs2d.pipeline.prepare.estimate import Estimate, estimate, expected_splats, limit_of
from gs2d.pipeline.prepare.loaded import LoadedRun, loaded_run
from gs2d.pipeline.prepare.open_capture import open_capture
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.prepare.resolve import resolve, schedule_scale_of
from gs2d.training.events import Notice, OnEvent

FORMAT = 1
SEAM_RATES = 0.3  # last fraction of a block's iterations, whose learning rates seams use; higher ones do harm
COARSE_PART = 3  # the coarse model has at most 1/3 of the splats that fit into memory


def definition_of(settled: LoadedRun, options: TrainOptions, partition: Partition) -> dict[str, Any]:
    """Return the content of ``blocks.json``, which is compared when a run continues."""
    capture = settled.resolved.scene
    return {
        "format": FORMAT,
        "capture": {"path": str(options.scene.resolve()), "digest": capture.digest, "format": capture.format},
        "downscale": settled.resolved.downscale,
        "partition": partition_json(partition),
        "recipe": to_json(settled.recipe),
        "protocol": json.loads(json.dumps(asdict(settled.protocol))),
        "seed": settled.recipe.seed,
        "backend": settled.backend.name,
    }


def settle(options: TrainOptions, on_event: OnEvent, recipe: Recipe | None = None) -> LoadedRun:
    """Read the headers of a capture and resolve the settings of all blocks, with the near plane of the whole scene.

    With a resolved ``recipe``, the protocol of the options is resolved, too. Nothing is written.
    """
    opened = open_capture(options, on_event)
    scale = schedule_scale_of(options, opened)
    if recipe is None:
        recipe, resolved = resolve(options, opened, on_event, seed=options.seed, schedule_scale=scale)
        if recipe.learns("poses"):
            raise RecipeError(
                "blocks need fixed cameras, got a recipe that learns poses; learn them in a run of its own, or leave "
                "poses out of --learn"
            )
        if recipe.dense_start is not None:  # each block would adjust cameras differently
            recipe = replace(recipe, dense_start=replace(recipe.dense_start, adjust=False))
        protocol = replace(resolved.protocol, near=resolved.protocol.near_for(opened.scene.extent))
        opened = replace(opened, protocol=protocol)
    digest, title = capture_digest(opened.scene), opened.scene.name
    return loaded_run(options, recipe, opened, digest, schedule_scale=scale, title=title)


def capture_digest(scene: Scene) -> str:
    """Return a hash of cameras, points, and names, sizes and times of photographs; a missing one is a DataError."""
    digest = hashlib.sha256()
    for split, views in (("train", scene.train), ("test", scene.test)):
        for view in views:
            camera = view.camera
            numbers = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
            digest.update(name_bytes(f"{split} {view.name}"))
            digest.update(np.array(numbers, np.float64).tobytes() + np.asarray(camera.T_cam_world).tobytes())
            if view.path is None:
                continue
            try:
                stat = view.path.stat()
            except OSError as error:
                raise DataError(f"image {view.path} cannot be read: {error.strerror or error}") from error
            digest.update(f"{stat.st_size} {stat.st_mtime_ns}".encode())
    if scene.points is not None:
        digest.update(np.ascontiguousarray(scene.points.points).tobytes())
    return digest.hexdigest()


# -- the grid ----------------------------------------------------------------------------------------------------------
def fitting_partition(
    settled: LoadedRun, options: TrainOptions, partition: Partition, on_event: OnEvent
) -> Partition | None:
    """Return the partition with as many blocks as memory needs; None if one training fits into memory."""
    estimated: Estimate | None = None
    recipe = settled.recipe
    try:
        estimated = estimate(settled.scene, recipe, settled.backend, downscale=settled.resolved.downscale)
    except DataError as error:
        on_event(Notice(f"one training does not fit: {error}"))
    if estimated is not None and estimated.max_splats is None:
        on_event(Notice("one training fits into memory: no blocks (--blocks 3x3 makes some)"))
        return None
    room = partition.splats if estimated is None or estimated.max_splats is None else estimated.max_splats
    coarse = replace(partition.coarse, max_splats=max(2, min(partition.coarse.max_splats, room // COARSE_PART)))
    trained = max(2, min(partition.splats, room - coarse.max_splats))
    photographs = math.ceil(len(settled.scene.train) / partition.photographs)
    count = max(2, photographs)
    if estimated is not None:
        expected = expected_splats(recipe, estimated.start).expected * (1 + 2 * partition.margin) ** 2
        count = max(count, math.ceil(expected / trained))
    points = settled.scene.points
    centers = np.array([view.camera.center for view in settled.scene.train])
    spread = spread_of(centers, None if points is None else points.points)
    grid = grid_for(count, [float(side) for side in spread.sides], partition.flat)
    allowed = memory_budget()
    on_event(
        Notice(
            f"blocks: {'x'.join(map(str, grid))}, of {trained:,} splats at most in "
            f"{'the available memory' if allowed is None else f'{allowed / 2**30:.3g} GiB'}"
        )
    )
    return replace(partition, grid=grid, splats=trained, coarse=coarse)


# -- recipes -----------------------------------------------------------------------------------------------------------
def with_budget(recipe: Recipe, splats: int) -> Recipe:
    """Return the recipe with a limit on splats, for densifiers that have one."""

    def limited(densify: GradDensify | Densify | None) -> GradDensify | Densify | None:
        if isinstance(densify, GradDensify):
            return replace(densify, max_splats=min(splats, densify.max_splats or splats))
        if densify is not None and "max_splats" in densify.options:
            most = min(splats, int(densify.options["max_splats"]))
            return replace(densify, options={**densify.options, "max_splats": most})
        return densify

    return replace(recipe, stages=tuple(replace(stage, densify=limited(stage.densify)) for stage in recipe.stages))


def budget_of(recipe: Recipe) -> int | None:
    """Return the limit on splats of a recipe; None: unlimited."""
    limits = (limit_of(stage.densify) for stage in recipe.stages if stage.densify is not None)
    return next((limit for limit in limits if limit is not None), None)


def coarse_recipe(recipe: Recipe, partition: Partition) -> Recipe:
    """Return the recipe of the coarse model."""
    coarse = partition.coarse
    value = scale_schedule(recipe, coarse.schedule)
    value = longer_steps(value, coarse.schedule) if recipe.removal is not None else value
    return validate(with_budget(value, coarse.max_splats))


def coarse_downscale(scene: Scene, partition: Partition, downscale: int) -> int:
    """Return the factor by which photographs are shrunk for the coarse model."""
    longer = max(max(view.camera.width, view.camera.height) for view in scene.views)
    return downscale * max(1, round(longer / partition.coarse.side))


def block_recipe(recipe: Recipe, partition: Partition, block: BlockOfSplit) -> Recipe:
    """Return the recipe of a block: with all SH degrees from the start, and fixed exposures.

    The limit on splats is the fraction ``block.weight`` of that of the whole scene.
    """
    whole = budget_of(recipe)
    most = partition.splats if whole is None else min(partition.splats, math.ceil(whole * block.weight))
    stages = tuple(replace(stage, sh_interval=0) for stage in recipe.stages)
    dense = recipe.dense_start if partition.start == "dense" else None
    dense = None if dense is None else replace(dense, required=False)  # else the coarse model is the start
    value = replace(_with_fixed_exposure(recipe), stages=stages, dense_start=dense)
    return validate(with_budget(value, max(2, most)))


def seam_recipe(recipe: Recipe, partition: Partition, photographs: float) -> Recipe:
    """Return the recipe of splats at seams: with the last learning rates of a block, without densification.

    ``photographs`` is the number of photographs that show a seam over that of a mean block. Iterations are proportional
    to it, up to those of a block.
    """
    part = min(1.0, partition.seam_schedule * max(1.0, photographs))
    block, stage = recipe.stages[0], scale_schedule(recipe, part).stages[0]
    start = round((1 - SEAM_RATES) * block.iterations)
    stage = replace(
        stage,
        name="seams",
        train=dict.fromkeys(ALL, "all"),
        losses=tuple(replace(term, start=0) for term in stage.losses),
        lr=over_again(block.lr, start, block.iterations, stage.iterations),
        densify=None,
        on_enter=(),
        sh_interval=0,
    )
    return validate(replace(_with_fixed_exposure(recipe), stages=(stage,), dense_start=None, removal=None))


def over_again(rates: LearningRates, start: int, stop: int, iterations: int) -> LearningRates:
    """Return rates that decay within ``iterations`` as the given ones do between two iterations."""
    before, after = rates.settled_at(start), rates.settled_at(stop)
    return replace(
        rates.times(before),
        means=rates.means_at(start),
        means_final=rates.means_at(stop),
        means_decay_steps=iterations,
        settle_start=0,
        settle_steps=iterations if after != before else 0,
        settle_factor=after / before if after != before else 0.0,
    )


def _with_fixed_exposure(recipe: Recipe) -> Recipe:
    """Return the recipe with fixed exposures, if it learns exposures."""
    exposure = recipe.quantities.get("exposure")
    return recipe if exposure is None else recipe.with_learned(exposure.with_options(initial="given"))


def seam_folder(out: Path) -> Path:
    """Return the run folder of the seams."""
    return out / "seams"


def coarse_folder(out: Path) -> Path:
    """Return the run folder of the coarse model."""
    return out / "coarse"


def partition_folder(out: Path) -> Path:
    """Return the folder of the cells and start files of blocks."""
    return out / "partition"


def block_folder(out: Path, name: str) -> Path:
    """Return the run folder of a block."""
    return out / "blocks" / name
