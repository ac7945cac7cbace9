"""Train a run: prepare, train stage by stage with checkpoints, score, render, mesh, report; resume exactly."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from gs2d.core.memory import hold
from gs2d.core.splats import Splats
from gs2d.data.archive import is_archive, named_by, unpack
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError, RunError
from gs2d.io.run_dir import (
    MESH,
    PAGE,
    REPORT,
    SPLATS,
    VERDICT,
    RunFolder,
    check_claim,
    claim_run,
    is_run,
    make_folder,
    remove_made,
)
from gs2d.pipeline.attempts import again, attempted
from gs2d.pipeline.events import TRAINED, Event, Notice, OnEvent, Phase, Plan, ignore
from gs2d.pipeline.finish.run_mesh import MeshFrames, extract_mesh, keep_facts
from gs2d.pipeline.finish.run_report import report_run
from gs2d.pipeline.finish.run_subject import meshed_subject
from gs2d.pipeline.finish.scoring import Visitor
from gs2d.pipeline.finish.verdict import Collector, write_verdict
from gs2d.pipeline.look.page import page_run
from gs2d.pipeline.prepare.estimate import estimate
from gs2d.pipeline.prepare.job import Job, check_train_options, prepare_job, recipe_of
from gs2d.pipeline.prepare.memory_budget import release, use_memory
from gs2d.pipeline.prepare.options import MeshOptions, TrainOptions
from gs2d.pipeline.prepare.photographs import PREPARED
from gs2d.pipeline.prepare.quality import by_quality
from gs2d.pipeline.prepare.threads import use_threads
from gs2d.pipeline.train.live import Live
from gs2d.pipeline.train.process_group import connected, follow, lead, memory_of
from gs2d.pipeline.train.resume import ResumePoint, check_sources, choose_start
from gs2d.pipeline.train.run_logger import RunLogger
from gs2d.pipeline.train.same_run import check_same_run
from gs2d.training import events
from gs2d.training.parallel import ONE_PROCESS, ManyProcesses, OneProcess
from gs2d.viewer.server import free_port

MANY = 500  # photographs, from which time and memory are estimated before training
UNPACKED = "unpacked"  # in the run folder: what came as a ZIP file


def train(options: TrainOptions, on_event: OnEvent = ignore) -> RunFolder:
    """Train a run to its end: splats, mesh, metrics, report.

    A run that fails before its first checkpoint leaves nothing behind; one that fails or is killed later can be
    resumed, and then ends with the same ``splats.ply``, byte for byte, as if it had never stopped.

    Parameters
    ----------
    options : TrainOptions
    on_event : callable
        Gets :mod:`gs2d.pipeline.events`.

    Returns
    -------
    RunFolder
        The finished run.

    Raises
    ------
    Gs2dError
        Anything that the user can mend.
    """
    with connected(options.backend) as together:
        if isinstance(together, ManyProcesses) and not together.leads:
            use_threads(options.threads, together.place.local_size)
            use_memory(memory_of(together.place, options.memory))
            return follow(options, together)
        return (_train_archive if is_archive(options.scene) else _train)(options, on_event, together)


def _train(options: TrainOptions, on_event: OnEvent, together: OneProcess) -> RunFolder:
    """Train a run that is the only one, or that others follow."""
    check_viewer(options)
    allowed = (*options.allowed, PREPARED)
    claim = {"resume": options.resume, "overwrite": options.overwrite, "allowed": allowed}
    check_claim(options.out, **claim)  # type: ignore[arg-type]
    use_threads(options.threads, together.place.local_size)
    use_memory(memory_of(together.place, options.memory))
    on_event(Plan(TRAINED))
    details: list[str] = []
    on_event = keeping_details(on_event, details)
    options = by_quality(options, on_event)
    job = prepare_job(options, on_event)
    if unlike := _unlike_its_run(options, job):
        on_event(Notice(unlike))
    if options.overwrite:
        check_sources(job, options)
    run = claim_run(options.out, **claim)  # type: ignore[arg-type]
    with run.locked(), discard_on_failure(run), watched(job, options, on_event) as live:
        on_event = on_event if live is None else live.on_event
        if options.cache is not None:  # now, not when the first stage has been trained
            run.made += make_folder(options.cache)
        if is_run(run.path):
            check_same_run(run, job)
            if run.file(SPLATS).exists() and not run.checkpoints():
                raise RunError(
                    f"{run.path} is finished and its checkpoints are gone: nothing to resume; "
                    "train it again with --overwrite, or choose another --out"
                )
        else:
            extra = {"title": options.title} if options.title else {}
            scale = options.schedule_scale
            if options.iterations is not None:
                scale = options.iterations / recipe_of(options.recipe).iterations
            run.write_definition({**job.definition(), "schedule_scale": scale, **extra})
        job = lead(job, options, together, on_event)
        start = choose_start(run, job, options, on_event)
        if start.state is None:
            for event in pretraining_notices(job, options):
                on_event(event)
            for text in details:
                run.events.append({"kind": "notice", "text": text})
        hold()
        if options.part is not None:
            train_stages(run, job, options, start, on_event, live=live)
            release(job.scene)
            return run
        collected = Collector(job.scene)
        with MeshFrames(job) as frames:
            visitors = [frames.visit, collected.visit]
            splats, now = train_stages(run, job, options, start, on_event, visitors, together, live)
            release(job.scene)  # before the volume of the mesh
            job = replace(job, scene=now)
            mesh = MeshOptions(subject_box=options.subject_box, whole_scene=options.whole_scene)
            finish(run, job, splats, mesh, on_event, frames, collected, with_page=options.page)
    return run


def _unlike_its_run(options: TrainOptions, job: Job) -> str:
    """Return how this training differs from that of the run whose folder the capture lies in, as of `reconstruct`."""
    home = Path(options.scene).absolute().parent
    if not is_run(home) or home.resolve() == options.out.resolve():
        return ""
    run = RunFolder(home).definition()
    pairs = (
        ("--schedule-scale", run.get("schedule_scale"), options.schedule_scale),
        ("--downscale", run.get("downscale"), job.downscale),
        ("--test-every", (run.get("protocol") or {}).get("test_every"), job.protocol.test_every),
    )
    others = " ".join(f"{name} {theirs:g}" for name, theirs, ours in pairs if theirs not in (None, ours))
    return f"{options.scene.parent} was trained with {others}; give the same for comparable results" if others else ""


def _is_planned(options: TrainOptions, views: int) -> bool:
    """Whether time and memory are estimated before a training begins."""
    return options.part is None and bool(options.estimate or options.memory or options.disk or views >= MANY)


def _train_archive(options: TrainOptions, on_event: OnEvent, together: OneProcess) -> RunFolder:
    """Train on a capture in a ZIP file, which is unpacked into the run folder, where later commands find it."""
    options = replace(options, allowed=(*options.allowed, UNPACKED), title=options.title or options.scene.stem)
    check_train_options(options)
    check_claim(options.out, resume=options.resume, overwrite=options.overwrite, allowed=options.allowed)
    home = options.out / UNPACKED
    made = make_folder(home)
    try:
        on_event(Phase(f"unpacking {options.scene.name}", 0))
        scene = unpack(options.scene, home)
        with named_by(options.scene, scene):
            return _train(replace(options, scene=scene), on_event, together)
    finally:  # what the run is not of goes: all of it where there is no run, the older one where a run was replaced
        used = RunFolder(options.out).definition()["scene"]["path"] if is_run(options.out) else ""
        for folder in home.iterdir():
            if folder.resolve() not in Path(used).resolve().parents:
                shutil.rmtree(folder, ignore_errors=True)
        remove_made((home, *made))


@contextmanager
def watched(job: Job, options: TrainOptions, on_event: OnEvent) -> Iterator[Live | None]:
    """Serve the page of a training while it lasts, with ``--viewer``."""
    if not options.viewer:
        yield None
        return
    live = Live(job, options, on_event)
    try:
        yield live
    finally:
        live.close()


def check_viewer(options: TrainOptions) -> None:
    """Raise for a page that cannot be served, before anything slow happens."""
    if not options.viewer:
        if options.viewer_port is not None:
            raise RecipeError("--viewer-port belongs to --viewer, which was not given; give both")
        return
    free_port(options.viewer_port, option="--viewer-port")


@contextmanager
def discard_on_failure(run: RunFolder) -> Iterator[None]:
    """Delete a run that fails before it has a checkpoint or a result: there is nothing in it to go on from."""
    try:
        yield
    except BaseException:
        if not run.checkpoints() and not run.file(SPLATS).exists():
            run.discard()
        raise


def train_stages(
    run: RunFolder,
    job: Job,
    options: TrainOptions,
    start: ResumePoint,
    on_event: OnEvent,
    visitors: Sequence[Visitor] = (),
    together: OneProcess = ONE_PROCESS,
    live: Live | None = None,
) -> tuple[Splats, Scene]:
    """Train from where ``start`` is to the end of the last stage; return the splats and the cameras as they are now.

    The splats are written before they are scored. ``visitors`` see every view of the finished splats.
    """
    from gs2d.training.trainer import Trainer

    recorder = RunLogger(run, job, options, start, on_event, visitors)

    def listen(event: events.Event) -> None:
        recorder.on_training_event(event)
        if live is not None:
            live.on_training_event(event, trainer.state, recorder.psnr)
        if isinstance(event, events.Progress):  # on a GPU the only time when nothing is under way
            recorder.stop_if_asked()

    trainer = Trainer(
        job.scene,
        job.recipe,
        job.protocol,
        backend=job.backend,
        on_event=listen,
        between=recorder.stop_if_asked,
        state=start.state,
        init=None if start.state is not None else job.init if job.part is None else job.part.own,
        frozen=None if job.part is None else job.part.frozen,
        within=None if job.part is None or job.recipe.dense_start is None else job.part.within,
        exposures=None if job.part is None else job.part.exposures,
        progress_every=recorder.progress_every,
        stage2_cache_bytes=job.stage2_cache_bytes,
        processes=together,
    )
    recorder.begin(trainer)
    with recorder.ending_well():
        trainer.run()
    return trainer.splats, trainer.scene_now()


def keeping_details(on_event: OnEvent, details: list[str]) -> OnEvent:
    """Return a listener that adds the text of each detail to ``details`` and passes every event on."""

    def listen(event: Event) -> None:
        if isinstance(event, Notice) and event.detail:
            details.append(event.text)
        on_event(event)

    return listen


def pretraining_notices(job: Job, options: TrainOptions) -> list[Event]:
    """Return what the user should know before training: photographs, image size, length and expected time."""
    scene, shrunk, shortened = job.scene, "", ""
    camera = max((view.camera for view in scene.views), key=lambda camera: max(camera.width, camera.height))
    if job.downscale > 1:
        shrunk = f" (--downscale {job.downscale})"
    if options.schedule_scale != 1:
        shortened = f" (--schedule-scale {options.schedule_scale:g})"
    if scene.test:
        held_out = f"{len(scene.test)} do not train, they score the result"
        held_out += "" if scene.own_split else " (--test-every 0 trains on all)"
    else:
        held_out = "none is held out to score the result"
        held_out += "" if scene.own_split else " (--test-every 8 holds some out)"
    told: list[Event] = [
        Notice(
            f"{len(scene.train)} of {len(scene.views)} photographs train at {camera.width}x{camera.height}{shrunk} for "
            f"{job.recipe.iterations:,} iterations{shortened}; {held_out}"
        )
    ]
    if _is_planned(options, len(scene.views)):
        start = None if job.init is None else len(job.init)
        found = estimate(scene, job.recipe, job.backend, downscale=job.downscale, prepare=options.prepare, start=start)
        told += [Notice(line, detail=True) for line in found.lines()]
        told += [Notice(found.line())] if options.estimate else []
    return told


def finish(
    run: RunFolder,
    job: Job,
    splats: Splats,
    mesh: MeshOptions,
    on_event: OnEvent,
    frames: MeshFrames,
    collected: Collector,
    *,
    with_page: bool,
) -> None:
    """Write each thing that is made of the splats of a run, whatever the others do."""
    with attempted(MESH, again("mesh", run.path), on_event):
        subject = meshed_subject(run, job, splats, mesh, on_event)
        if not (run.file(MESH).exists() and "mesh" in run.metrics()):  # a kill may come between the two
            keep_facts(run, extract_mesh(job, splats, mesh, run.file(MESH), on_event, subject=subject, seen=frames))
    if with_page and not run.file(PAGE).exists():
        with attempted(PAGE, again("page", run.path), on_event):
            page_run(run.path, on_event=on_event, job=job)
    with attempted(VERDICT, again("evaluate", run.path), on_event):
        write_verdict(run, job, collected)
    on_event(Phase("writing the report", 0))  # last: it links to the others
    with attempted(REPORT, again("report", run.path), on_event):
        report_run(run.path, on_event)
