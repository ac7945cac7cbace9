"""Where the photographs of a run are while it trains: in memory, or prepared on the disk where they would not fit."""

from __future__ import annotations

from pathlib import Path

import torch

from gs2d.core.atomic_files import disk_error
from gs2d.data import Scene
from gs2d.data.prepared import (
    check_disk,
    decoded_bytes,
    forget_others,
    missing_views,
    packed_bytes,
    prepare,
    prepared_scene,
)
from gs2d.errors import DataError
from gs2d.pipeline.prepare.resolved import Execution
from gs2d.training.events import Notice, OnEvent, Phase, Step

PREPARED = "prepared"  # in the run folder
HOW = ("auto", "always", "never")


def fits(scene: Scene) -> bool:
    """Whether the pictures of a scene stay in its cache once they were decoded."""
    return decoded_bytes(scene) <= min((view.cache.max_bytes for view in scene.views), default=0)


def with_prepared(
    scene: Scene,
    run: Path,
    execution: Execution,
    on_event: OnEvent,
    *,
    shared: bool = False,
) -> Scene:
    """Return the scene as it is trained on, its photographs prepared in the run folder where that is wanted.

    Parameters
    ----------
    execution : Execution
        ``prepare`` is "always", "never", or "auto": where the images would not stay in memory.
    shared : bool
        Other runs keep photographs there too: what is not of this scene stays.
    """
    how, threads = execution.prepare, execution.threads
    if how == "never" or (how == "auto" and fits(scene)):
        return scene
    folder = run / PREPARED
    chosen = prepared_scene(scene, folder)
    missing = missing_views(chosen)
    check_disk(run, missing, execution.disk_bytes)
    size = decoded_bytes(scene) / 2**30
    where = f"prepared in {folder}, {packed_bytes(scene.views) / 2**30:.2g} GiB at most, and read ahead"
    on_event(Notice(f"photographs of {size:.2g} GiB do not stay in memory: {where} (--prepare never reads the files)"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not shared:
            forget_others(chosen, folder)
    except OSError as error:
        raise disk_error(folder, error) from error
    if missing:
        done = len(scene.views) - len(missing)
        on_event(Phase("preparing photographs", len(scene.views), done))
        for number, _ in enumerate(prepare(missing, threads or torch.get_num_threads()), start=done + 1):
            on_event(Step(number))
    return chosen


def already_prepared(scene: Scene, run: Path) -> Scene:
    """Return the scene with what its run has prepared of it; the scene itself where that is nothing. Writes nothing."""
    folder = run / PREPARED
    if not folder.is_dir():
        return scene
    try:
        return prepared_scene(scene, folder)
    except DataError:
        return scene  # a photograph is gone: whoever needs it says so


__all__ = ["HOW", "PREPARED", "already_prepared", "fits", "with_prepared"]
