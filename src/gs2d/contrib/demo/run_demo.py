"""The demo: a synthetic capture with a known surface, trained, meshed, scored and reported in one folder."""

from __future__ import annotations

from pathlib import Path

from gs2d.contrib.demo.demo_capture import write_demo_capture
from gs2d.contrib.demo.demo_command import DemoOptions
from gs2d.errors import RunError
from gs2d.io.run_dir import RunFolder, is_run, open_run
from gs2d.pipeline.attempts import again, attempted
from gs2d.pipeline.finish.evaluate import evaluate_run
from gs2d.pipeline.prepare.limits import use_threads
from gs2d.pipeline.prepare.options import EvaluateOptions, HowItRuns, TrainOptions, values
from gs2d.pipeline.prepare.resolve import check_options
from gs2d.pipeline.train.train_run import check_places, train
from gs2d.training.events import OnEvent, Phase, Step, ignore

CAPTURE, TRUTH = "capture", "mesh_gt.ply"
CAPTURE_FILES = ("train", "test", "transforms_train.json", "transforms_test.json")  # and mesh_gt*
TITLE = "gs2d demo: a still life with a known surface"
SCHEDULE_SCALE = 0.15


def demo(
    options: DemoOptions = DemoOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
) -> RunFolder:
    """Run the demo. An earlier demo in the same folder is replaced; any other run is an error."""
    capture = options.out / CAPTURE
    overwrite = options.overwrite
    if is_run(options.out) and not options.resume and not overwrite:
        where = open_run(options.out).definition()["scene"]["path"]
        if Path(where) != capture.resolve():
            raise RunError(
                f"{options.out} holds a run that is not a demo; choose another --out or replace it with --overwrite"
            )
        overwrite = True
    training = _train_options(options, overwrite=overwrite)
    check_options(training)  # before the photographs are rendered, which takes a while
    check_places(training, (CAPTURE,))
    use_threads(options.threads)
    if not (options.resume and (capture / "transforms_train.json").exists()):
        _check_capture(capture)
        on_event(Phase("photographing the demo scene", options.train_views + options.test_views))
        write_demo_capture(
            capture,
            seed=0,
            train_views=options.train_views,
            test_views=options.test_views,
            size=options.size,
            on_progress=lambda done, _total: on_event(Step(done)),
            threads=options.threads,
        )
    run = train(training, on_event, title=TITLE, allowed=(CAPTURE,))
    truth = capture / TRUTH
    with attempted("scores of the surface", again("evaluate", run.path, "--ground-truth", truth), on_event):
        evaluate_run(run.path, EvaluateOptions(ground_truth=truth), on_event)
    return run


def _check_capture(folder: Path) -> None:
    """Raise if a folder has files that are not of a demo."""
    names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    others = [name for name in names if name not in CAPTURE_FILES and not name.startswith((".", "mesh_gt"))]
    if others:
        raise RunError(f"{folder} is not the capture of a demo: it holds {others[0]}; choose another --out")


def _train_options(options: DemoOptions, *, overwrite: bool) -> TrainOptions:
    """Return the options of the training."""
    shared = {**values(HowItRuns, options), "overwrite": overwrite}
    return TrainOptions(
        scene=options.out / CAPTURE,
        recipe=options.recipe,
        learn="none",
        viewer=options.viewer,
        schedule_scale=SCHEDULE_SCALE if options.schedule_scale is None else options.schedule_scale,
        page=options.page,
        **shared,
    )
