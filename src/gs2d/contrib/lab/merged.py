"""The merged scene of all blocks as a run: splats, scores, mesh, page and report."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from gs2d.contrib.lab.block_start import OWN, read_start
from gs2d.contrib.lab.partition import Partition
from gs2d.contrib.lab.partition import to_json as partition_json
from gs2d.contrib.lab.settle import block_folder, coarse_folder, partition_folder, seam_folder
from gs2d.contrib.lab.split import SEAMS, merge, read_split, split_seams, start_file
from gs2d.core.json_files import read_json, write_json
from gs2d.core.memory import hold
from gs2d.core.splats import Splats
from gs2d.errors import RunError
from gs2d.io.run_dir import SPLATS, RunFolder, is_run, open_run
from gs2d.io.splat_ply import read_splats, write_splats
from gs2d.pipeline.attempts import attempted
from gs2d.pipeline.finish.run_images import draw_stage
from gs2d.pipeline.finish.run_verdict import Collector
from gs2d.pipeline.finish.scoring import peak_memory, score_views, split_metrics
from gs2d.pipeline.prepare.learned_views import (
    with_learned_appearance,
    with_maps,
    write_appearance,
    write_maps,
)
from gs2d.pipeline.prepare.limits import release
from gs2d.pipeline.prepare.loaded import LoadedRun, finished_splats
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.prepare.predicted_views import predicted
from gs2d.pipeline.train.train_run import finish
from gs2d.training.events import OnEvent

MERGED, SEAM_VIEWS = "merged.ply", "seams.json"  # in the run folder: merged blocks, photographs of their seams
STAGE = "blocks"  # the stage of a merged run in metrics.json


def merged_splats(out: Path) -> Splats:
    """Return the splats of all blocks, each cropped to its cell, or raise RunError if a block is not finished."""
    split = read_split(partition_folder(out))
    coarse = finished_splats(open_run(coarse_folder(out)))
    trained = [block.name for block in split.blocks if not block.skipped]
    splats = {name: finished_splats(open_run(block_folder(out, name))) for name in trained}
    rows = {name: read_start(start_file(partition_folder(out), name))[0] for name in trained}
    return merge(coarse, split, splats, rows)


def write_merged(settled: LoadedRun, options: TrainOptions, partition: Partition, on_event: OnEvent) -> dict[str, Any]:
    """Write the merged splats and the start of the seams: ``MERGED``, ``seams.npz``, ``seams.json``.

    Returns the number of ``splats``, and of ``views`` that show a seam.
    """
    out, splats, views = options.out, merged_splats(options.out), tuple[str, ...]()
    if partition.seam > 0 and partition.seam_schedule > 0:
        views = split_seams(
            settled.trained(
                splats.to(settled.backend.device),
                with_learned_appearance(open_run(coarse_folder(out)), settled.recipe, settled.scene),
            ),
            read_split(partition_folder(out)),
            partition,
            partition_folder(out),
            on_event,
        )
    write_splats(out / MERGED, splats)
    write_json(out / SEAM_VIEWS, {"views": list(views)})
    return {"splats": len(splats), "views": len(views)}


def read_seam_views(out: Path) -> tuple[str, ...]:
    """Return the views that show the seams of the merged scene, or raise DataError or RunError."""
    data = read_json(out / SEAM_VIEWS)
    views = data.get("views") if isinstance(data, dict) else None
    if not isinstance(views, list) or not all(isinstance(view, str) for view in views):
        raise RunError(f"{out / SEAM_VIEWS} must list views by name, got something else; delete it, and {MERGED} too")
    return tuple(views)


def write_result(settled: LoadedRun, options: TrainOptions, partition: Partition, on_event: OnEvent) -> int:
    """Write the merged scene with its trained seams as a run; return the number of splats."""
    run, splats = RunFolder(options.out), read_splats(options.out / MERGED)
    if read_seam_views(options.out):
        rows, _ = read_start(start_file(partition_folder(options.out), SEAMS))
        rest = splats.rows(torch.from_numpy(rows != OWN))
        splats = rest.followed_by(finished_splats(open_run(seam_folder(options.out))))
    run.write_definition({**settled.resolved.to_json(), "partition": partition_json(partition)})
    coarse = open_run(coarse_folder(options.out))
    write_appearance(run, with_learned_appearance(coarse, settled.recipe, settled.scene), on_event)
    write_maps(run, with_maps(coarse, settled.scene), on_event)
    run.events.cut(0)
    write_splats(run.file(SPLATS), splats)
    return len(splats)


def finish_merged(settled: LoadedRun, options: TrainOptions, on_event: OnEvent) -> dict[str, Any]:
    """Score and mesh the merged scene, write page, verdict and report; return its entry of ``metrics.json``."""
    run = RunFolder(options.out)
    if not run.file(SPLATS).exists():
        raise RunError(f"{options.out} must have {SPLATS}, found none; run the command again")
    scene, splats = with_maps(run, settled.scene), read_splats(run.file(SPLATS)).to(settled.backend.device)
    shown = predicted(settled.trained(splats, with_learned_appearance(run, settled.recipe, scene)))
    entry = {**_spent(options.out), "splats": len(splats), "bytes": splats.nbytes}
    collected = Collector(scene)
    hold()
    for split, views in (("train", shown.scene.train), ("test", shown.scene.test)):
        scores = score_views(shown, views, on_event, split=split, visitors=[collected.visit])
        entry |= split_metrics(scores, split)
    with attempted(f"images of {STAGE}", None, on_event):
        draw_stage(run, shown, STAGE, None)
    release(scene)
    entry["peak_memory_bytes"] = max(entry["peak_memory_bytes"], peak_memory())
    run.write_metrics({"stages": [entry], "surface": None})
    finish(run, settled.trained(splats), on_event, collected, page=options.page)
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
