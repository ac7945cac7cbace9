"""The merged scene of all blocks as a run: splats, scores, mesh, page and report."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from gs2d.contrib.lab.block_start import OWN, read_start
from gs2d.contrib.lab.partition import Partition
from gs2d.contrib.lab.partition import to_json as partition_json
from gs2d.contrib.lab.settle import Settled, block_folder, coarse_folder, partition_folder, seam_folder
from gs2d.contrib.lab.split import SEAMS, merge, read_split, split_seams, start_file
from gs2d.core.json_files import read_json, write_json
from gs2d.core.memory import hold
from gs2d.core.splats import Splats
from gs2d.data import Scene
from gs2d.errors import RunError
from gs2d.io.run_dir import SPLATS, RunFolder, is_run, open_run
from gs2d.io.splat_ply import read_splats, write_splats
from gs2d.pipeline.attempts import attempted
from gs2d.pipeline.finish.run_images import draw_stage
from gs2d.pipeline.finish.run_verdict import Collector
from gs2d.pipeline.finish.scoring import peak_memory, score_views, split_metrics
from gs2d.pipeline.prepare.learned_views import with_learned_appearance, write_appearance
from gs2d.pipeline.prepare.limits import release
from gs2d.pipeline.prepare.loaded import LoadedRun, finished_splats
from gs2d.pipeline.prepare.options import TrainOptions, values
from gs2d.pipeline.prepare.predicted_exposure import metered, with_predicted
from gs2d.pipeline.prepare.resolved import CaptureRecord, Execution, ResolvedRun
from gs2d.pipeline.train.train_run import finish
from gs2d.training.events import OnEvent
from gs2d.training.trainer import raster_settings

MERGED, SEAM_VIEWS = "merged.ply", "seams.json"  # in the run folder: merged blocks, photographs of their seams
STAGE = "blocks"  # the stage of a merged run in metrics.json


def merged_splats(out: Path) -> Splats:
    """Return the splats of all blocks, each cropped to its cell.

    Raises
    ------
    RunError
        If a block is not finished.
    """
    split = read_split(partition_folder(out))
    coarse = finished_splats(open_run(coarse_folder(out)))
    trained = [block.name for block in split.blocks if not block.skipped]
    splats = {name: finished_splats(open_run(block_folder(out, name))) for name in trained}
    rows = {name: read_start(start_file(partition_folder(out), name))[0] for name in trained}
    return merge(coarse, split, splats, rows)


def write_merged(settled: Settled, options: TrainOptions, partition: Partition, on_event: OnEvent) -> dict[str, Any]:
    """Write the merged splats and the start of the seams: ``MERGED``, ``seams.npz``, ``seams.json``.

    Returns
    -------
    dict
        Number of ``splats``, and of ``views`` that show a seam.
    """
    out, splats, views = options.out, merged_splats(options.out), tuple[str, ...]()
    if partition.seam > 0 and partition.seam_schedule > 0:
        views = split_seams(
            splats.to(settled.backend.device),
            read_split(partition_folder(out)),
            with_learned_appearance(open_run(coarse_folder(out)), settled.recipe, settled.scene),
            partition,
            raster_settings(settled.protocol, settled.scene.extent, settled.recipe.sh_degree, settled.recipe.mip_px),
            settled.backend,
            partition_folder(out),
            on_event,
        )
    write_splats(out / MERGED, splats)
    write_json(out / SEAM_VIEWS, {"views": list(views)})
    return {"splats": len(splats), "views": len(views)}


def read_seam_views(out: Path) -> tuple[str, ...]:
    """Return the views that show the seams of the merged scene.

    Raises
    ------
    DataError, RunError
        If the file is missing or damaged.
    """
    found = read_json(out / SEAM_VIEWS)
    views = found.get("views") if isinstance(found, dict) else None
    if not isinstance(views, list) or not all(isinstance(view, str) for view in views):
        raise RunError(f"{out / SEAM_VIEWS} must list views by name, got something else; delete it, and {MERGED} too")
    return tuple(views)


def write_result(settled: Settled, options: TrainOptions, partition: Partition, on_event: OnEvent) -> int:
    """Write the merged scene with its trained seams as a run; return the number of splats."""
    run, splats = RunFolder(options.out), read_splats(options.out / MERGED)
    if read_seam_views(options.out):
        rows, _ = read_start(start_file(partition_folder(options.out), SEAMS))
        rest = splats.rows(torch.from_numpy(rows != OWN))
        splats = rest.followed_by(finished_splats(open_run(seam_folder(options.out))))
    definition = merged_run(settled, options, settled.scene).resolved.to_json()
    run.write_definition({**definition, "partition": partition_json(partition)})
    coarse = open_run(coarse_folder(options.out))
    write_appearance(run, with_learned_appearance(coarse, settled.recipe, settled.scene), on_event)
    run.events.cut(0)
    write_splats(run.file(SPLATS), splats)
    return len(splats)


def merged_run(settled: Settled, options: TrainOptions, scene: Scene) -> LoadedRun:
    """Return the merged scene as a loaded run."""
    resolved = ResolvedRun(
        recipe=settled.recipe,
        protocol=settled.protocol,
        scene=CaptureRecord.of(scene, settled.capture),
        downscale=options.downscale or 1,
        raster=raster_settings(settled.protocol, scene.extent, settled.recipe.sh_degree, settled.recipe.mip_px),
        backend=settled.backend.facts(),
        schedule_scale=1.0 if options.schedule_scale is None else options.schedule_scale,
        title=settled.scene.name,
        execution=Execution(**values(Execution, options)),
    )
    return LoadedRun(resolved, scene, settled.backend)


def finish_merged(settled: Settled, options: TrainOptions, on_event: OnEvent) -> dict[str, Any]:
    """Score and mesh the merged scene, write page, verdict and report; return its entry of ``metrics.json``."""
    run = RunFolder(options.out)
    if not run.file(SPLATS).exists():
        raise RunError(f"{options.out} must have {SPLATS}, found none; run the command again")
    scene = settled.scene
    loaded = merged_run(settled, options, scene)
    splats = read_splats(run.file(SPLATS)).to(loaded.backend.device)
    known = with_learned_appearance(run, loaded.recipe, scene)
    seen = with_predicted(known, metered(splats, loaded.settings, loaded.backend))
    entry = {**_spent(options.out), "splats": len(splats), "bytes": splats.nbytes}
    collected = Collector(scene)
    hold()
    for split, views in (("train", seen.train), ("test", seen.test)):
        drawing, seen_by = (loaded.settings, loaded.backend), [collected.visit]
        scores = score_views(splats, views, *drawing, on_event, split=split, visitors=seen_by)
        entry |= split_metrics(scores, split)
    with attempted(f"images of {STAGE}", None, on_event):
        draw_stage(run, loaded, seen, STAGE, splats, None)
    release(scene)
    entry["peak_memory_bytes"] = max(entry["peak_memory_bytes"], peak_memory())
    run.write_metrics({"stages": [entry], "surface": None})
    finish(run, loaded, splats, on_event, collected)
    return entry


def _spent(out: Path) -> dict[str, Any]:
    """Return iterations and seconds of all trainings together, and the peak memory of one."""
    stages = [stage for run in _trained(out) for stage in run.metrics()["stages"]]
    return {
        "name": STAGE,
        "iterations": sum(stage["iterations"] for stage in stages),
        "seconds": round(sum(stage["seconds"] for stage in stages), 3),
        "peak_memory_bytes": max((stage.get("peak_memory_bytes") or 0 for stage in stages), default=0),
    }


def _trained(out: Path) -> Iterable[RunFolder]:
    split = read_split(partition_folder(out))
    folders = [block_folder(out, block.name) for block in split.blocks if not block.skipped]
    return [RunFolder(path) for path in (coarse_folder(out), *folders, seam_folder(out)) if is_run(path)]
