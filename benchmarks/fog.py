"""Measure floaters in test views of real captures, for several variants of robust training (docs/notebook/floaters.md).

::

    python -m benchmarks.fog CAPTURE[:DOWNSCALE] ... [--variants off robust ...] [--scale 0.05] [--out FILE.json]

Trains each capture, which must have COLMAP sparse points with tracks, once per variant. Every 8th view is held out.
Reports PSNR and SSIM of test views, the worst test view, PSNR after an affine colour fit (which removes exposure
differences), PSNR of training views, the share of sparse points hidden in test views (mean and worst view), the share
of blending weight of all training views that lies clearly closer to a camera than 99 % of the sparse points, the share
of training pixels with alpha below 0.9, the number of splats, and CPU time. Runs on one thread; on a shared machine,
CPU times are only roughly comparable, and only within one run.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.config.protocols import GENERIC, Protocol
from gs2d.config.recipe import Recipe, Removal
from gs2d.core.sh import C0
from gs2d.core.splats import Splats
from gs2d.data import Scene, View, load_scene
from gs2d.evaluation.hidden_points import hidden_points
from gs2d.evaluation.image_metrics import image_metrics, psnr_float
from gs2d.pipeline.prepare.learned_views import photographed
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.pipeline.prepare.options import Training
from gs2d.pipeline.prepare.predicted_views import predicted
from gs2d.pipeline.prepare.resolve import build_recipe, robust_and_exposure, with_backdrop
from gs2d.render.api import rasterize
from gs2d.render.exposure_transform import fit_exposure
from gs2d.render.types import RasterSettings
from gs2d.training.trainer import Trainer

NEAR_PERCENTILE, NEARER = 1.0, 0.9  # quantile of sparse point depths in the photographs that show them; margin
TRAINING_VIEWS = 12  # number of scored views, evenly spaced
OPAQUE = 0.9  # alpha below which a training pixel counts as transparent


def _without(field: str) -> Callable[[Recipe], Recipe]:
    return lambda recipe: replace(recipe, **{field: None})  # type: ignore[arg-type]


VARIANTS: Mapping[str, tuple[dict[str, Any], Callable[[Recipe], Recipe]]] = {  # options, and a recipe change
    "off": ({"robust": "off"}, lambda recipe: recipe),
    "robust": ({}, lambda recipe: recipe),
    "no dense start": ({}, _without("dense_start")),
    "no removal": ({}, _without("removal")),
    "no decay": ({}, lambda recipe: replace(recipe, removal=Removal(decay=0.0))),
    "no dropout": ({}, lambda recipe: replace(recipe, removal=Removal(dropout=0.0))),
    "no exposure": ({"exposure": False}, lambda recipe: recipe),
    "black background": ({}, lambda recipe: recipe),
    "off, exposure": ({"robust": "off", "exposure": True}, lambda recipe: recipe),
}


def train_variant(scene: Scene, name: str, recipe: str, scale: float, seed: int) -> tuple[Trainer, float]:
    """Train a scene with a variant; return the trainer and the CPU seconds."""
    asked, change = VARIANTS[name]
    training = Training(recipe=recipe, **asked)
    start = time.process_time()
    robust, exposure = robust_and_exposure(training, scene, GENERIC, lambda event: None)
    fitted = build_recipe(training, seed=seed, schedule_scale=scale, robust=robust, exposure=exposure)
    protocol: Protocol = GENERIC
    if name != "black background":
        fitted, protocol = with_backdrop(fitted, GENERIC, scene, lambda event: None)
    trainer = Trainer(scene, change(fitted), protocol, backend="cpu")
    trainer.run()
    return trainer, time.process_time() - start


@torch.no_grad()
def measure(scene: Scene, trainer: Trainer) -> dict[str, Any]:
    """Return the figures of a trained scene."""
    settings, splats = trainer.settings, trainer.splats
    seen = predicted(Trained(splats, trainer.scene_now(), trainer.protocol, settings, trainer.backend)).scene
    tests = [_score(scene, view, splats, settings) for view in seen.test]
    by_view = [score["psnr"] for score in tests]
    chosen = seen.train[:: max(1, len(scene.train) // TRAINING_VIEWS)]
    trains = [_score(scene, view, splats, settings) for view in chosen]
    hidden = [score.pop("points") for score in tests]
    return {
        "test": {key: float(np.mean([score[key] for score in tests])) for key in ("psnr", "ssim", "fitted")},
        "worst": min(by_view),
        "views": by_view,
        "transparent": float(np.mean([score["transparent"] for score in trains])),
        "train": float(np.mean([score["psnr"] for score in trains])),
        "hidden": float(np.concatenate(hidden).mean()) if sum(map(len, hidden)) else None,
        "hidden_worst": max((float(points.mean()) for points in hidden if len(points)), default=0.0),
        "near_weight": near_weight(scene, splats, settings),
        "splats": len(splats),
    }


def _score(scene: Scene, view: View, splats: Splats, settings: RasterSettings) -> dict[str, Any]:
    output = rasterize(splats, view.camera, settings, backend="cpu")
    color = photographed(view, output.color, settings.background)
    target, pixels = torch.from_numpy(view.target(settings.background)), view.mask()
    mask = None if pixels is None else torch.from_numpy(pixels)
    everywhere = torch.ones(target.shape[:2], dtype=torch.bool) if mask is None else mask
    fit = fit_exposure(output.color, target, everywhere)
    fitted = output.color @ fit[:, :3].T + fit[:, 3]
    points = np.zeros(0, dtype=bool)
    observed = scene.observed(guessed=False)
    if observed is not None:
        points = hidden_points(output.depth_median.numpy(), observed.in_view(view.name, view.camera))
    return {
        "psnr": psnr_float(color, target, mask),
        "fitted": psnr_float(fitted, target, mask),
        "ssim": image_metrics(color, target, mask, backend="cpu").ssim.value,
        "points": points,
        "transparent": float((output.alpha[everywhere] < OPAQUE).float().mean()),
    }


def near_weight(scene: Scene, splats: Splats, settings: RasterSettings) -> float:
    """Return the share of blending weight, over all training views, of splats closer than nearly all sparse points.

    The weight of a splat in a view is the derivative of the sum of all pixels with respect to its colour.
    """
    observed = scene.observed(guessed=False)
    assert observed is not None
    depths = [observed.in_view(view.name, view.camera).depth for view in scene.train]
    limit = NEARER * float(np.percentile(np.concatenate(depths), NEAR_PERCENTILE))
    near, whole = 0.0, 0.0
    for view in scene.train:
        parts = {name: tensor.detach() for name, tensor in splats.items()}
        parts["sh0"] = torch.full_like(parts["sh0"], 0.5).requires_grad_()
        with torch.enable_grad():
            output = rasterize(Splats(**parts), view.camera, replace(settings, sh_degree=0), backend="cpu")
            output.color.sum().backward()  # type: ignore[no-untyped-call]
        assert parts["sh0"].grad is not None
        weight = parts["sh0"].grad[:, 0, 0] / C0
        depth = view.camera.project(splats.means.numpy().astype(np.float64))[1]
        near += float(weight[torch.from_numpy(depth < limit)].sum())
        whole += float(weight.sum())
    return near / whole if whole else 0.0


def show(rows: Sequence[dict[str, Any]]) -> str:
    """Return the figures as a Markdown table."""
    lines = [
        "| capture | variant | test | worst | SSIM | colour fitted | training | hidden | worst | near | transparent "
        "| splats | CPU |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        test = row["test"]
        lines.append(
            f"| {row['capture']} | {row['variant']} | {test['psnr']:.2f} | {row['worst']:.2f} | {test['ssim']:.3f} "
            f"| {test['fitted']:.2f} | {row['train']:.2f} | {row['hidden']:.2%} | {row['hidden_worst']:.1%} "
            f"| {row['near_weight']:.1%} | {row['transparent']:.1%} | {row['splats']:,} | {row['cpu_seconds']:.0f} |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the arguments, train and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", metavar="CAPTURE[:DOWNSCALE]")
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=["off", "robust"])
    parser.add_argument("--recipe", default="2dgs")
    parser.add_argument("--scale", type=float, default=0.05)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    rows = []
    for capture in args.captures:
        path, _, downscale = capture.partition(":")
        scene = load_scene(path, downscale=int(downscale or 1))
        if scene.observed(guessed=False) is None or not scene.test:
            raise SystemExit(f"{path} must say which sparse points its photographs show, and have test views")
        for variant in args.variants:
            trainer, seconds = train_variant(scene, variant, args.recipe, args.scale, args.seed)
            about = {"capture": Path(path).name, "downscale": int(downscale or 1), "variant": variant}
            how = {"recipe": args.recipe, "scale": args.scale, "seed": args.seed}
            rows.append({**about, **how, **measure(scene, trainer), "cpu_seconds": seconds})
            print(show(rows[-1:]).splitlines()[-1], flush=True)
            if args.out is not None:
                args.out.write_text(json.dumps(rows, indent=1) + "\n")
    print(show(rows))


if __name__ == "__main__":
    main()
