"""Score a finished run: its splats against photographs, its mesh against a true surface."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gs2d.errors import RunError
from gs2d.evaluation.evaluators import check_thresholds, choose_truth, score_surface
from gs2d.evaluation.image_metrics import ImageMetrics, image_metrics
from gs2d.evaluation.lpips import load_lpips
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import MESH, SURFACE, VERDICT
from gs2d.pipeline.attempts import attempted_file
from gs2d.pipeline.finish.run_report import report_again
from gs2d.pipeline.finish.run_verdict import Collector, write_verdict
from gs2d.pipeline.finish.scoring import RenderedPhotograph, score_views, split_metrics
from gs2d.pipeline.prepare.learned_views import aligned, matched_by_halves
from gs2d.pipeline.prepare.loaded import open_finished
from gs2d.pipeline.prepare.options import EvaluateOptions
from gs2d.pipeline.prepare.predicted_exposure import metered, with_predicted
from gs2d.training.events import Notice, OnEvent, Phase, ignore


def evaluate_run(
    path: Path,
    options: EvaluateOptions = EvaluateOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    threads: int | None = None,
) -> dict[str, Any]:
    """Score the splats of a run, and its mesh if there is a true surface; update metrics, verdict and report."""

    def tell(text: str) -> None:
        on_event(Notice(text))

    check_thresholds(options.thresholds)
    wanted = options.matched
    path, named = Path(path), options.ground_truth
    truth = None if named is None or named.is_dir() else choose_truth(named, named.parent, tell)
    lpips = None if options.lpips_weights is None else load_lpips(options.lpips_weights)
    run, loaded, splats = open_finished(path, threads, on_event)
    lpips = None if lpips is None else lpips.to(loaded.backend.device)
    result: dict[str, Any] = {"run": str(run.path), "surface": run.metrics().get("surface")}
    if truth is None and loaded.scene.root is not None:
        truth = choose_truth(named, loaded.scene.root, tell)
    has_mesh = run.file(MESH).exists()
    if truth is not None and not has_mesh and named is not None:
        raise RunError(f"{path} has no {MESH}; make it with `gs2d mesh {path}`")
    drawing = (loaded.settings, loaded.backend)

    matched: dict[str, ImageMetrics] = {}

    def match(seen: RenderedPhotograph, _: ImageMetrics) -> None:
        if seen.split == "test":
            image = matched_by_halves(seen.view, seen.output.color, seen.target, seen.mask, loaded.settings.background)
            matched[seen.view.name] = image_metrics(image, seen.target, seen.mask, backend=loaded.backend, lpips=lpips)

    scene, collected = with_predicted(loaded.scene, metered(splats, *drawing)), Collector(loaded.scene)
    visitors = [collected.visit, match] if "exposure" in wanted else [collected.visit]
    for split, views in (("train", scene.train), ("test", scene.test)):
        scores = score_views(splats, views, *drawing, on_event, split=split, lpips=lpips, visitors=visitors)
        result |= split_metrics(scores, split)
        result[f"{split}_views"] = {view: metrics.to_json() for view, metrics in scores.items()}
    if "exposure" in wanted:
        result |= split_metrics(matched, "test_matched", "test")
    if "poses" in wanted:
        best = tuple(aligned(splats, scene.test, *drawing, loaded.scene.extent, on_event))
        result |= split_metrics(score_views(splats, best, *drawing, on_event, lpips=lpips), "test_aligned", "test")
    if truth is not None and has_mesh:
        mesh, folder, thresholds = read_mesh(run.file(MESH)), run.file(SURFACE), options.thresholds
        on_event(Phase("scoring the surface", 0))
        result["surface"] = score_surface(mesh, truth, loaded.scene, folder=folder, tell=tell, thresholds=thresholds)
    elif truth is not None:
        on_event(Notice(f"the surface is not scored: no {MESH}; make it with `gs2d mesh {path}`"))
    with run.locked():
        metrics = run.metrics()
        last = {k: v for k, v in result.items() if k.startswith(("train", "test")) and not k.endswith("_views")}
        stages = [*metrics["stages"][:-1], {**metrics["stages"][-1], **last}] if metrics["stages"] else []
        run.write_metrics({**metrics, "stages": stages, "surface": result["surface"]})
        with attempted_file(run, VERDICT, on_event):
            result["verdict"] = write_verdict(run, loaded, collected)
    report_again(run, on_event)
    return result
