"""``gs2d plan``: what training on a capture takes, and whether it fits."""

from __future__ import annotations

import shlex
from dataclasses import replace

from gs2d.data import detect_format
from gs2d.data.archive import is_archive, unpacked_for_a_moment
from gs2d.errors import DataError, RecipeError
from gs2d.pipeline.capture_plan import CapturePlan, plan_capture, set_words
from gs2d.pipeline.events import Notice, OnEvent, Phase, ignore
from gs2d.pipeline.job import (
    Job,
    choose_backend,
    choose_protocol,
    read_scene,
    settled,
)
from gs2d.pipeline.memory import use_memory
from gs2d.pipeline.options import PlanOptions, TrainOptions
from gs2d.pipeline.threads import use_threads


def plan(options: PlanOptions, on_event: OnEvent = ignore) -> CapturePlan:
    """Plan a training: headers are read, a few photographs are tried, nothing is written.

    Raises
    ------
    Gs2dError
        The capture cannot be read, or training on it cannot fit into memory or disk.
    """
    if is_archive(options.scene):
        with unpacked_for_a_moment(options.scene) as folder:
            return plan(replace(options, scene=folder), on_event)
    use_threads(options.threads)
    use_memory(options.memory)
    if options.downscale < 1:
        raise RecipeError(f"--downscale must be a whole number >= 1, got {options.downscale}")
    if options.disk is not None and not options.disk > 0:
        raise RecipeError(f"--disk must be a positive number of GiB, got {options.disk}")
    training = TrainOptions(
        scene=options.scene,
        out=options.scene,
        recipe=options.recipe,
        downscale=options.downscale,
        schedule_scale=options.schedule_scale,
        overrides=options.overrides,
        backend=options.backend,
        no_exposure=True,
    )
    backend = choose_backend(options.backend, on_event)
    kind = detect_format(options.scene)
    protocol = choose_protocol(training, kind, on_event)
    scene = read_scene(options.scene, kind, options.downscale, protocol, on_event)
    on_event(Phase("trying a few photographs", 0))
    recipe, protocol = settled(training, scene, protocol, on_event)
    found = plan_capture(scene, recipe, protocol, backend, downscale=options.downscale, prepare=options.prepare)
    check_disk_of(found, options.disk)
    return found


def check_disk_of(found: CapturePlan, disk: float | None) -> None:
    """Refuse a plan that takes more disk than is allowed, GiB.

    Raises
    ------
    DataError
    """
    if disk is not None and found.disk > disk * 2**30:
        raise DataError(
            f"{found.photographs:,} photographs take about {found.disk / 2**30:.2g} GiB of disk, got {disk:g} GiB that "
            "--disk allows; use a larger --downscale, or allow more"
        )


def planned_of(job: Job, prepare: str) -> CapturePlan:
    """Return the plan of a training that is about to begin.

    Raises
    ------
    Gs2dError
    """
    return plan_capture(job.scene, job.recipe, job.protocol, job.backend, downscale=job.downscale, prepare=prepare)


def command_of(options: PlanOptions, found: CapturePlan) -> str:
    """Return the command that trains as planned."""
    words = ["gs2d", "train", str(options.scene), "--out", "RUN"]
    words += ["--downscale", str(found.downscale)] if found.downscale > 1 else []
    words += ["--recipe", str(options.recipe)] if options.recipe != PlanOptions.recipe else []
    words += ["--schedule-scale", f"{options.schedule_scale:g}"] if options.schedule_scale != 1 else []
    words += set_words((*options.overrides, *found.budget))
    words += ["--memory", f"{options.memory:g}"] if options.memory is not None else []
    words += ["--disk", f"{options.disk:g}"] if options.disk is not None else []
    return shlex.join(words)


def plan_notices(job: Job, prepare: str, *, timed: bool) -> list[Notice]:
    """Return what is said before a training begins; how long it takes too, unless that is going to be measured."""
    lines = planned_of(job, prepare).lines()
    return [Notice(line, detail=True) for line in lines if timed or not line.startswith("time: ")]
