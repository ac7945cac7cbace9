"""Score a finished run: its splats on the views, its mesh against a ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gs2d.errors import RunError
from gs2d.evaluation.evaluators import check_thresholds, choose_truth, score_surface
from gs2d.evaluation.lpips import load_lpips
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import (
    MESH,
    SURFACE,
    VERDICT,
)
from gs2d.pipeline.attempts import again, attempted
from gs2d.pipeline.finish.run_report import report_again
from gs2d.pipeline.finish.scoring import score_views, split_metrics
from gs2d.pipeline.finish.verdict import Collector, write_verdict
from gs2d.pipeline.prepare.loaded import open_finished
from gs2d.pipeline.prepare.options import EvaluateOptions
from gs2d.pipeline.prepare.predicted_exposure import metered, with_predicted
from gs2d.pipeline.prepare.run_poses import aligned
from gs2d.training.events import Notice, OnEvent, Phase, ignore


def evaluate_run(
    path: Path,
    options: EvaluateOptions = EvaluateOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    threads: int | None = None,
) -> dict[str, Any]:
    """Score the final splats of a run, and its mesh against a ground truth; updates ``metrics.json`` and the report."""

    def tell(text: str) -> None:
        on_event(Notice(text))

    check_thresholds(options.thresholds)
    path, given = Path(path), options.ground_truth
    truth = None if given is None or given.is_dir() else choose_truth(given, given.parent, tell)
    lpips = None if options.lpips_weights is None else load_lpips(options.lpips_weights)
    run, loaded, splats = open_finished(path, threads, on_event)
    lpips = None if lpips is None else lpips.to(loaded.backend.device)
    result: dict[str, Any] = {"run": str(run.path), "surface": run.metrics().get("surface")}
    if truth is None and loaded.scene.root is not None:
        truth = choose_truth(given, loaded.scene.root, tell)
    has_mesh = run.file(MESH).exists()
    if truth is not None and not has_mesh and given is not None:
        raise RunError(f"{path} has no {MESH}; make it with `gs2d mesh {path}`")
    drawing = (loaded.settings, loaded.backend)
    scene = with_predicted(loaded.scene, metered(splats, *drawing))
    if options.match_exposure:
        name = "scoring test views, colours matched"
        scores = score_views(splats, loaded.scene.test, *drawing, name=name, on_event=on_event, lpips=lpips, match=True)
        result |= split_metrics(scores, "test_matched", "test")
    if options.match_poses:
        name = "scoring test views, cameras aligned"
        best = tuple(aligned(splats, loaded.scene.test, *drawing, loaded.scene.extent, on_event))
        scores = score_views(splats, best, *drawing, name=name, on_event=on_event, lpips=lpips)
        result |= split_metrics(scores, "test_aligned", "test")
    collected = Collector(loaded.scene)
    for split, views in (("train", scene.train), ("test", scene.test)):
        name = f"scoring {split} views"
        more: dict[str, Any] = {"split": split, "visitors": [collected.visit]}
        scores = score_views(splats, views, *drawing, name=name, on_event=on_event, lpips=lpips, **more)
        result |= split_metrics(scores, split)
        result[f"{split}_views"] = {view: metrics.to_json() for view, metrics in scores.items()}
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
        with attempted(VERDICT, again("evaluate", path), on_event):
            result["verdict"] = write_verdict(run, loaded, collected)["verdict"]
    report_again(run, on_event)
    return result
