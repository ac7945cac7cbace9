"""Train a run: prepare, train stage by stage with checkpoints, score, mesh, report; resume exactly."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace

from gs2d.core.memory import hold
from gs2d.errors import RunError
from gs2d.io.run_dir import (
    EDITS,
    MESH,
    PAGE,
    SPLATS,
    VERDICT,
    RunFolder,
    check_claim,
    claim_run,
    is_run,
    make_folder,
    remove_created,
)
from gs2d.pipeline.attempts import again, attempted_file
from gs2d.pipeline.finish.run_mesh import extract_mesh, write_mesh_metrics
from gs2d.pipeline.finish.run_report import report_again
from gs2d.pipeline.finish.run_subject import meshed_subject
from gs2d.pipeline.finish.run_verdict import Collector, write_verdict
from gs2d.pipeline.look.page import page_run
from gs2d.pipeline.prepare.estimate import estimate
from gs2d.pipeline.prepare.limits import release, use_memory, use_threads
from gs2d.pipeline.prepare.loaded import LoadedRun, Trained, check_same_run, prepare_run
from gs2d.pipeline.prepare.options import MeshOptions, TrainOptions
from gs2d.pipeline.train.live import Live
from gs2d.pipeline.train.process_group import connected, follow, lead
from gs2d.pipeline.train.resume import choose_start
from gs2d.pipeline.train.run_logger import RunLogger, progress_every
from gs2d.training.events import Event, Notice, OnEvent, Phase, Progress, TrainingEvent, ignore
from gs2d.training.parallel import ProcessGroup
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from gs2d.viewer.page_server import free_port


def train(
    options: TrainOptions,
    on_event: OnEvent = ignore,
    *,
    title: str = "",
    allowed: tuple[str, ...] = (),
    prepare: Callable[[TrainOptions, OnEvent], LoadedRun] | None = None,
) -> RunFolder:
    """Train a run and write splats, mesh, metrics, page and report; return the finished run.

    A run that fails before its first checkpoint leaves nothing behind. One that is interrupted later can be resumed,
    with a byte-identical ``splats.ply``. ``title`` is the heading of the report, by default the name of the capture.
    Files named in ``allowed`` may already be in ``options.out``. ``prepare`` makes the run from the options, for a part
    of a scene, whose splats only are written. Raises Gs2dError if options, capture or machine do not allow the run; the
    message says what to do.
    """
    with connected(options.backend) as together:
        use_threads(options.threads, together.place.local_size)
        use_memory(options.memory, together.place.local_size)
        if not together.leads:
            return follow(options, together)
        check_places(options, allowed)
        reported: list[Event] = []

        def listen(event: Event) -> None:
            reported.append(event)
            on_event(event)

        loaded = prepare_run(options, listen, title=title) if prepare is None else prepare(options, listen)
        run = claim_run(options.out, resume=options.resume, overwrite=options.overwrite, allowed=allowed)
        with (
            run.locked(),
            discard_on_failure(run),
            nullcontext() if options.viewer is None else closing(Live(loaded, on_event)) as live,
        ):
            report = on_event if live is None else live.on_event
            run.created += () if options.cache is None else make_folder(options.cache)
            if is_run(run.path):
                check_same_run(run, loaded.resolved)
                if run.file(EDITS).exists():
                    raise RunError(
                        f"the splats of {run.path} were edited, and --resume would replace them; undo the edits with "
                        f"`{again('edit', run.path, '--undo')}`, or train into another --out"
                    )
                if run.file(SPLATS).exists() and not run.checkpoints():
                    raise RunError(
                        f"{run.path} is finished and has no checkpoints to resume; train it again with --overwrite, or "
                        "choose another --out"
                    )
            else:
                run.write_definition(loaded.resolved.to_json())
            loaded = lead(loaded, together, report)
            start = choose_start(run, loaded, report)
            if start[0] is None:
                report(Notice(_training_line(loaded)))
                if prepare is None:
                    initial = None if loaded.init is None else len(loaded.init)
                    shrunk = loaded.resolved.downscale
                    needed = estimate(loaded.scene, loaded.recipe, loaded.backend, downscale=shrunk, start=initial)
                    report(Notice(needed.line()))
                for event in reported:
                    if isinstance(event, Notice) and event.detail:
                        run.events.append({"kind": Notice.kind, "text": event.text})
            hold()
            collected = Collector(loaded.scene) if prepare is None else None
            trained = train_stages(run, loaded, start, report, collected, together, live)
            release(loaded.scene)  # before the volume of the mesh
            if collected is not None:
                finish(run, trained, report, collected, page=options.page)
        return run


def check_places(options: TrainOptions, allowed: tuple[str, ...] = ()) -> None:
    """Raise for a run folder, port or cache that cannot be used; ``allowed`` is as for :func:`train`."""
    check_claim(options.out, resume=options.resume, overwrite=options.overwrite, allowed=allowed)
    if options.viewer is not None:
        free_port(options.viewer or None, option="--viewer")
    if options.cache is not None:  # an unusable folder fails here, not after the first stage
        remove_created(make_folder(options.cache))


@contextmanager
def discard_on_failure(run: RunFolder) -> Iterator[None]:
    """Delete a run that fails before it has a checkpoint or a result."""
    try:
        yield
    except BaseException:
        if not run.checkpoints() and not run.file(SPLATS).exists():
            run.discard()
        raise


def train_stages(
    run: RunFolder,
    loaded: LoadedRun,
    start: tuple[TrainState | None, float],
    on_event: OnEvent,
    collected: Collector | None,
    together: ProcessGroup,
    live: Live | None,
) -> Trained:
    """Train from ``start`` (:func:`choose_start`) to the end; return splats, and the scene with refined cameras.

    The splats are written before they are scored. ``collected`` measures every view of the finished splats.
    """

    def listen(event: TrainingEvent) -> None:
        recorder.on_training_event(event)
        if live is not None:
            live.on_training_event(event, trainer.state, recorder.psnr)
        if isinstance(event, Progress):  # on a GPU, the only event at which no work is queued
            recorder.stop_if_requested()

    state, seconds = start
    trainer = Trainer(
        loaded.scene,
        loaded.recipe,
        loaded.protocol,
        backend=loaded.backend,
        on_event=listen,
        state=state,
        init=loaded.init if state is None else None,
        options=replace(
            loaded.options,
            between=lambda: recorder.stop_if_requested(),
            progress_every=progress_every(loaded),
            processes=together,
        ),
    )
    recorder = RunLogger(run, loaded, trainer, seconds, on_event, collected)
    recorder.begin()
    with recorder.ending_well():
        trainer.run()
    return loaded.trained(trainer.splats, trainer.scene_now())


def _training_line(loaded: LoadedRun) -> str:
    """Return photographs, image size and length of a training in one line."""
    scene, resolved = loaded.scene, loaded.resolved
    camera = max((view.camera for view in scene.views), key=lambda camera: max(camera.width, camera.height))
    shrunk = f" (--downscale {resolved.downscale})" if resolved.downscale > 1 else ""
    shortened = f" (--schedule-scale {resolved.schedule_scale:g})" if resolved.schedule_scale != 1 else ""
    if scene.test:
        split, other = f"{len(scene.test)} are held out for testing", "--test-every 0 trains on all"
    else:
        split, other = "none is held out for testing", "--test-every 8 holds out every eighth"
    if not scene.own_split:
        split += f" ({other})"
    return (
        f"{len(scene.train)} of {len(scene.views)} photographs train at {camera.width}x{camera.height}{shrunk} for "
        f"{loaded.recipe.iterations:,} iterations{shortened}; {split}"
    )


def finish(run: RunFolder, trained: Trained, on_event: OnEvent, collected: Collector, *, page: bool) -> None:
    """Write mesh, page, verdict and report of a run; a failure of one does not prevent the others."""
    mesh = MeshOptions()
    with attempted_file(run, MESH, on_event):
        subject = meshed_subject(run, trained, mesh, on_event)
        if not (run.file(MESH).exists() and "mesh" in run.metrics()):  # a kill may come between the two
            write_mesh_metrics(run, extract_mesh(trained, mesh, run.file(MESH), on_event, subject=subject))
    if page and not run.file(PAGE).exists():
        with attempted_file(run, PAGE, on_event):
            page_run(run.path, on_event=on_event, trained=trained)
    with attempted_file(run, VERDICT, on_event):
        write_verdict(run, trained, collected)
    on_event(Phase("writing the report", 0))  # last: it links to the others
    report_again(run, on_event)
