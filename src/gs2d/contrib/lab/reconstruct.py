"""``gs2d reconstruct --cluster``: the search for the cameras and the training as two tasks of a cluster.

Each goes on from what it kept where its machine is lost. Both run on one machine each: what is found in the features of
one photograph, and by comparing two, lies in one database, which no two machines write.
"""

from __future__ import annotations

import contextlib
import secrets
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from gs2d.contrib.lab.execute import execute
from gs2d.contrib.lab.options import ReconstructAnywhereOptions
from gs2d.contrib.lab.tasks import Task, failures
from gs2d.errors import RecipeError, RunError
from gs2d.io.run_dir import REPORT, SPLATS, RunFolder, is_run, remove_made
from gs2d.pipeline.events import OnEvent, ignore
from gs2d.pipeline.prepare.options import ReconstructOptions, values
from gs2d.pipeline.reconstruct import CAPTURE, CLUSTER, check_reconstruct, find_cameras, train_found
from gs2d.pipeline.reconstruct import reconstruct as reconstruct_here
from gs2d.sfm.workspace import POSES_JSON

CAMERAS, TRAINING = "cameras", "training"


@dataclass(frozen=True, kw_only=True)
class ReconstructTask(Task):
    """A part of the way from photographs to a mesh.

    Attributes
    ----------
    options : ReconstructOptions
        Of all of it.
    command : str
        Of which command it is. What another one did says nothing: its options may have been others.
    """

    options: ReconstructOptions
    command: str

    def with_threads(self, threads: int) -> Self:
        """Return the task on so many CPU threads."""
        return replace(self, options=replace(self.options, threads=threads))

    def facts(self) -> dict[str, Any]:
        """Return the command that it is of."""
        return {"command": self.command}

    def is_done(self) -> bool:
        """Return whether this command has done it."""
        return super().is_done() and self.outcome().get("command") == self.command


@dataclass(frozen=True, kw_only=True)
class CamerasTask(ReconstructTask):
    """Find the cameras, once; a second process of the same task takes what the first has left."""

    def work(self, on_event: OnEvent) -> dict[str, Any]:
        """Find them, or go on."""
        found = replaced_file(self.record.parent, self.command)
        overwrite = self.options.overwrite and not found.exists()
        find_cameras(replace(self.options, overwrite=overwrite, resume=not overwrite), on_event)
        if overwrite:
            found.touch()
        return {}


@dataclass(frozen=True, kw_only=True)
class TrainingTask(ReconstructTask):
    """Train on what was found, with mesh, page and report."""

    def work(self, on_event: OnEvent) -> dict[str, Any]:
        """Train, or go on."""
        train_found(replace(self.options, overwrite=False, resume=True), on_event)
        return {}


def replaced_file(jobs: Path, command: str) -> Path:
    """Return the file that says that a command has replaced the cameras of an earlier run."""
    return jobs / f"{command}.replaced"


def reconstruct(options: ReconstructAnywhereOptions, on_event: OnEvent = ignore) -> RunFolder:
    """Find the cameras of photographs and train on them, here or on the machines of a cluster; resumable.

    Raises
    ------
    Gs2dError
        What can be refused is refused before anything is made.
    """
    plain = ReconstructOptions(**values(ReconstructOptions, options))
    if options.cluster is None:
        return reconstruct_here(plain, on_event)
    if plain.training.viewer or plain.training.viewer_port is not None:
        raise RecipeError("--viewer shows a training of this machine, got it with --cluster; leave one out")
    check_reconstruct(plain)
    with _undone_for_nothing(options.out):
        tasks = tasks_of(plain)
        execute(
            tasks,
            options.out / CLUSTER,
            on_event,
            threads=options.threads,
            backend=options.backend,
            cluster=options.cluster,
        )
        replaced_file(tasks[0].record.parent, tasks[0].command).unlink(missing_ok=True)
        failed = failures(tasks)
        if failed:
            name, reason = next(iter(failed.items()))
            raise RunError(reason if name == CAMERAS else f"{reason}; what is done is kept: --resume goes on")
    return RunFolder(options.out)


def tasks_of(options: ReconstructOptions) -> tuple[CamerasTask, TrainingTask]:
    """Return the tasks: the cameras, and what is trained on them."""
    jobs, command = options.out / CLUSTER / "jobs", secrets.token_hex(8)
    common: dict[str, Any] = {"options": options, "command": command, "alone": True, "memory": options.memory}
    poses = options.out / CAPTURE / POSES_JSON
    return (
        CamerasTask(name=CAMERAS, record=jobs / f"{CAMERAS}.json", outputs=(poses,), gpu=False, **common),
        TrainingTask(
            name=TRAINING,
            record=jobs / f"{TRAINING}.json",
            after=(CAMERAS,),
            inputs=(poses,),
            outputs=(options.out / SPLATS, options.out / REPORT),
            **common,
        ),
    )


@contextlib.contextmanager
def _undone_for_nothing(out: Path) -> Iterator[None]:
    """Remove what was made, where it comes to an end before there are cameras to go on with."""
    made = tuple(folder for folder in (out / CLUSTER, out, *out.parents) if not folder.exists())
    try:
        yield
    except BaseException:
        if out / CLUSTER in made and not (is_run(out) or (out / CAPTURE).exists()):
            shutil.rmtree(out / CLUSTER, ignore_errors=True)
            remove_made(made)
        raise
