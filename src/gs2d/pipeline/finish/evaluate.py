"""Score a finished run: its splats against photographs, its mesh against a true surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gs2d.config.recipe import LossTerm
from gs2d.core.transforms import perturb_pose
from gs2d.data import View
from gs2d.errors import RunError
from gs2d.evaluation.evaluators import check_thresholds, choose_truth, score_surface
from gs2d.evaluation.image_metrics import ImageMetrics, image_metrics
from gs2d.evaluation.lpips import load_lpips
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import MESH, SURFACE, VERDICT
from gs2d.losses.base import LossView, compute_losses
from gs2d.pipeline.attempts import attempted_file
from gs2d.pipeline.finish.run_report import report_again
from gs2d.pipeline.finish.run_verdict import Collector, write_verdict
from gs2d.pipeline.finish.scoring import RenderedPhotograph, score_views, split_metrics
from gs2d.pipeline.prepare.learned_views import over, photographed
from gs2d.pipeline.prepare.loaded import Trained, open_finished
from gs2d.pipeline.prepare.options import EvaluateOptions
from gs2d.pipeline.prepare.predicted_views import predicted
from gs2d.render.api import rasterize
from gs2d.render.exposure_transform import expose, fit_exposure
from gs2d.training.events import Notice, OnEvent, Phase, counted, ignore

STEPS = 80  # of Adam, to align a test view
RATE, RATE_FINAL = 2e-3, 2e-5  # rad and extents
PHOTOMETRIC = (LossTerm("l1", 0.8), LossTerm("ssim", 0.2))


def evaluate_run(
    path: Path,
    options: EvaluateOptions = EvaluateOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    threads: int | None = None,
) -> dict[str, Any]:
    """Score the splats of a run, and its mesh if there is a true surface; update metrics, verdict and report."""

    def notify(text: str) -> None:
        on_event(Notice(text))

    check_thresholds(options.thresholds)
    comparisons = options.matched
    path, named = Path(path), options.ground_truth
    truth = None if named is None or named.is_dir() else choose_truth(named, named.parent, notify)
    lpips = None if options.lpips_weights is None else load_lpips(options.lpips_weights)
    run, trained = open_finished(path, threads, on_event)
    lpips = None if lpips is None else lpips.to(trained.backend.device)
    result: dict[str, Any] = {"run": str(run.path), "surface": run.metrics().get("surface")}
    if truth is None and trained.scene.root is not None:
        truth = choose_truth(named, trained.scene.root, notify)
    has_mesh = run.file(MESH).exists()
    if truth is not None and not has_mesh and named is not None:
        raise RunError(f"{path} has no {MESH}; make it with `gs2d mesh {path}`")
    matched: dict[str, ImageMetrics] = {}

    def match(pair: RenderedPhotograph, _: ImageMetrics) -> None:
        if pair.split == "test":
            image = matched_by_halves(pair, trained.settings.background)
            matched[pair.view.name] = image_metrics(image, pair.target, pair.mask, backend=trained.backend, lpips=lpips)

    shown, collected = predicted(trained), Collector(trained.scene)
    visitors = [collected.visit, match] if "exposure" in comparisons else [collected.visit]
    for split, views in (("train", shown.scene.train), ("test", shown.scene.test)):
        scores = score_views(trained, views, on_event, split=split, lpips=lpips, visitors=visitors)
        result |= split_metrics(scores, split)
        result[f"{split}_views"] = {view: metrics.to_json() for view, metrics in scores.items()}
    if "exposure" in comparisons:
        result |= split_metrics(matched, "test_matched", "test")
    if "poses" in comparisons:
        best = tuple(aligned(trained, shown.scene.test, on_event))
        result |= split_metrics(score_views(trained, best, on_event, lpips=lpips), "test_aligned", "test")
    if truth is not None and has_mesh:
        mesh, scene, folder = read_mesh(run.file(MESH)), trained.scene, run.file(SURFACE)
        on_event(Phase("scoring the surface", 0))
        thresholds = options.thresholds
        result["surface"] = score_surface(mesh, truth, scene, folder=folder, notify=notify, thresholds=thresholds)
    elif truth is not None:
        on_event(Notice(f"the surface is not scored: no {MESH}; make it with `gs2d mesh {path}`"))
    with run.locked():
        metrics = run.metrics()
        last = {k: v for k, v in result.items() if k.startswith(("train", "test")) and not k.endswith("_views")}
        stages = [*metrics["stages"][:-1], {**metrics["stages"][-1], **last}] if metrics["stages"] else []
        run.write_metrics({**metrics, "stages": stages, "surface": result["surface"]})
        with attempted_file(run, VERDICT, on_event):
            result["verdict"] = write_verdict(run, trained, collected)
    report_again(run, on_event)
    return result


def matched_by_halves(rendered: RenderedPhotograph, background: tuple[float, float, float]) -> Tensor:
    """Return a rendering with its colours matched to the photograph.

    Each half gets the transform that fits the other half best (least squares), so that no pixel is matched to itself.
    """
    view, color, target, mask = rendered.view, rendered.output.color, rendered.target, rendered.mask
    camera = replace(view, appearance={k: numbers for k, numbers in view.appearance.items() if k != "exposure"})
    color, cover = photographed(camera, color, background), over(view, color, background)
    usable = torch.ones_like(color[..., 0], dtype=torch.bool) if mask is None else mask.clone()
    if cover:
        usable &= cover[0] > 0
    left_half = torch.zeros_like(usable)
    left_half[:, : color.shape[1] // 2] = True
    to_right = expose(color, fit_exposure(color, target, usable & left_half, *cover), *cover)
    to_left = expose(color, fit_exposure(color, target, usable & ~left_half, *cover), *cover)
    return torch.where(left_half[..., None], to_left, to_right)


def aligned(trained: Trained, views: Sequence[View], on_event: OnEvent) -> Iterator[View]:
    """Yield views with their cameras aligned to their photographs, by the photometric loss of the fixed splats.

    Renderings have the appearance of the photographs, if it was learned. Scores of aligned views measure the scene
    apart from errors of its test cameras.
    """
    splats, settings, backend = trained.splats, trained.settings, trained.backend
    unit = torch.tensor([1.0] * 3 + [trained.scene.extent] * 3, dtype=torch.float64)
    for view in counted(views, "aligning cameras of test views", len(views), on_event):
        target = torch.from_numpy(view.target(settings.background)).to(splats.means)
        pixels = view.mask()
        mask = None if pixels is None else torch.from_numpy(pixels).to(splats.device)
        motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        optimizer = torch.optim.Adam([motion], lr=RATE)
        decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, (RATE_FINAL / RATE) ** (1 / STEPS))
        for _ in range(STEPS):
            camera = perturb_pose(view.camera, motion * unit)
            output = rasterize(splats, camera, settings, backend=backend)
            output = replace(output, color=photographed(view, output.color, settings.background))
            compared = LossView(target, camera, mask)
            loss = sum(compute_losses(output, compared, PHOTOMETRIC, backend=backend).values())
            optimizer.zero_grad()
            if isinstance(loss, torch.Tensor) and loss.requires_grad:
                loss.backward()
            optimizer.step()
            decay.step()
        yield view.at(perturb_pose(view.camera, motion.detach() * unit).T_cam_world)
