"""Image metrics of splats over many views, and peak memory."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from gs2d.data import View
from gs2d.evaluation.image_metrics import ImageMetrics, image_metrics, mean_metrics, psnr_float
from gs2d.evaluation.lpips import Lpips
from gs2d.pipeline.prepare.learned_views import photographed
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.render.types import RenderOutput
from gs2d.training.events import OnEvent, counted
from gs2d.training.photographs import TrainedViews


@dataclass(frozen=True, eq=False)
class RenderedPhotograph:
    """A rendered view with its photograph."""

    view: View
    split: str  # "train", "test" or ""
    output: RenderOutput  # without distortion, in the colours of the scene
    image: torch.Tensor  # [H, W, 3]; colour with the appearance of the photograph; may exceed 1
    target: torch.Tensor  # [H, W, 3]; the photograph over the background, in [0, 1]
    mask: torch.Tensor | None  # [H, W] bool; False = ignore this pixel


Visitor = Callable[[RenderedPhotograph, ImageMetrics], None]
"""Receives each view with its scores; must not keep the images."""


def score_views(
    trained: Trained,
    views: Sequence[View],
    on_event: OnEvent,
    *,
    split: str = "",
    lpips: Lpips | None = None,
    visitors: Sequence[Visitor] = (),
) -> dict[str, ImageMetrics]:
    """Return the image metrics of each view by its name; ``split`` is passed to the visitors.

    Views are rendered with the appearance of their photographs, if learned. Masked pixels are ignored. On backends that
    render rays, test views that are faces are scored as whole photographs; visitors get the faces with these scores.
    """
    whole = split == "test" and trained.backend.takes_rays and trained.settings.near_plane_policy == "draw"
    photographs = TrainedViews(views, whole=whole, masks=True, like=trained.splats.means).views
    scores: dict[str, ImageMetrics] = {}
    renderings = _rendered(trained, photographs, split)
    for rendered in counted(renderings, f"scoring {split} views" if split else "scoring", len(photographs), on_event):
        view, pair = rendered.view, (rendered.image, rendered.target, rendered.mask)
        scores[view.name] = metrics = image_metrics(*pair, backend=trained.backend, lpips=lpips)
        faces = [each for each in views if view.camera.rays is not None and each.path == view.path]
        for shown in _rendered(trained, faces, split) if faces and visitors else (rendered,):
            for visit in visitors:
                visit(shown, metrics)
    return scores


def mean_psnr(trained: Trained, views: Sequence[View]) -> float | None:
    """Return the mean PSNR of views, of images that are not rounded to 8 bits."""
    values = [psnr_float(rendered.image, rendered.target, rendered.mask) for rendered in _rendered(trained, views)]
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def _rendered(trained: Trained, views: Sequence[View], split: str = "") -> Iterator[RenderedPhotograph]:
    settings = replace(trained.settings, sh_degree=trained.splats.sh_degree, with_distortion=False)
    trained = replace(trained, settings=settings)
    for view in views:
        output = trained.render(view.camera)
        target = torch.from_numpy(view.target(settings.background)).to(output.color)
        pixels = view.mask()
        mask = None if pixels is None else torch.from_numpy(pixels).to(target.device)
        image = photographed(view, output.color, settings.background)
        yield RenderedPhotograph(view, split, output, image, target, mask)


def split_metrics(scores: dict[str, ImageMetrics], name: str, split: str | None = None) -> dict[str, Any]:
    """Return ``{name: means}``, or null with the reason if the scene has no views of ``split`` (default: ``name``)."""
    if not scores:
        return {name: None, f"{name}_reason": f"the scene has no {split or name} views"}
    return {name: mean_metrics(list(scores.values())).to_json()}


def peak_memory() -> int:
    """Return the peak resident memory of this process, bytes."""
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak if sys.platform == "darwin" else peak * 1024)
