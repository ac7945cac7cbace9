"""Keep the photographs of a run in memory, or prepared on disk where they do not fit."""

from __future__ import annotations

from pathlib import Path

import torch

from gs2d.core.atomic_files import disk_error
from gs2d.data import Scene
from gs2d.data.prepared import (
    check_disk,
    decoded_bytes,
    delete_unused,
    missing_views,
    packed_bytes,
    prepare,
    prepared_scene,
)
from gs2d.errors import DataError
from gs2d.pipeline.prepare.resolved import Execution
from gs2d.training.events import Notice, OnEvent, Phase, Step

PREPARED = "prepared"  # in the run folder
PREPARE = ("auto", "always", "never")


def fits(scene: Scene) -> bool:
    """Return whether the decoded images of a scene fit into its cache."""
    return decoded_bytes(scene) <= min((view.cache.max_bytes for view in scene.views), default=0)


def with_prepared(scene: Scene, run: Path, execution: Execution, on_event: OnEvent, *, shared: bool = False) -> Scene:
    """Return the scene with photographs prepared in the run folder if ``execution`` requires it.

    Parameters
    ----------
    shared : bool
        Other runs keep photographs in the same folder: do not delete files of other scenes.
    """
    if execution.prepare == "never" or (execution.prepare == "auto" and fits(scene)):
        return scene
    folder = run / PREPARED
    prepared = prepared_scene(scene, folder)
    missing = missing_views(prepared)
    check_disk(run, missing)
    on_event(
        Notice(
            f"{decoded_bytes(scene) / 2**30:.2g} GiB of photographs do not fit into memory: prepared in {folder}, at "
            f"most {packed_bytes(scene.views) / 2**30:.2g} GiB (--set prepare=never reads the files instead)"
        )
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not shared:
            delete_unused(prepared, folder)
    except OSError as error:
        raise disk_error(folder, error) from error
    if missing:
        done = len(scene.views) - len(missing)
        on_event(Phase("preparing photographs", len(scene.views), done))
        for number, _ in enumerate(prepare(missing, execution.threads or torch.get_num_threads()), start=done + 1):
            on_event(Step(number))
    return prepared


def already_prepared(scene: Scene, run: Path) -> Scene:
    """Return the scene with the photographs that its run has prepared, if any. Writes nothing."""
    folder = run / PREPARED
    try:
        return prepared_scene(scene, folder) if folder.is_dir() else scene
    except DataError:
        return scene  # a photograph is missing: reading it reports that
