"""Image metrics of a scene of splats over many views, and how much memory it took."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gs2d.data import View
from gs2d.evaluate.images import ImageMetrics, image_metrics, mean_metrics, psnr_float
from gs2d.evaluate.lpips import Lpips
from gs2d.pipeline.events import OnEvent, Phase, Step
from gs2d.pipeline.exposure import NONE, Transforms, matched_by_halves, photographed
from gs2d.render.api import rasterize
from gs2d.render.backend import Backend
from gs2d.render.types import RasterSettings
from gs2d.splats import Splats


def score_views(
    splats: Splats,
    views: Sequence[View],
    settings: RasterSettings,
    backend: Backend,
    *,
    name: str,
    on_event: OnEvent,
    lpips: Lpips | None = None,
    exposures: Transforms = NONE,
    match: bool = False,
) -> dict[str, ImageMetrics]:
    """Image metrics of each view by its name; pixels that the view's mask leaves out count nowhere.

    A view with a transform in ``exposures`` is rendered in the exposure of its photograph, any other as the scene is;
    with ``match`` by :func:`~gs2d.pipeline.exposure.matched_by_halves`.
    """
    on_event(Phase(name, len(views)))
    scores: dict[str, ImageMetrics] = {}
    for done, drawn in enumerate(_drawn(splats, views, settings, backend, exposures, match), start=1):
        scores[drawn.name] = image_metrics(
            drawn.image, drawn.target, drawn.mask, backend_name=backend.name, lpips=lpips
        )
        on_event(Step(done))
    return scores


def mean_psnr(
    splats: Splats,
    views: Sequence[View],
    settings: RasterSettings,
    backend: Backend,
    exposures: Transforms = NONE,
) -> float | None:
    """Mean ``psnr_float`` of the views that have one, as by :func:`score_views`, without the other metrics."""
    values = [psnr_float(d.image, d.target, d.mask) for d in _drawn(splats, views, settings, backend, exposures)]
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A view of the splats and its photograph."""

    name: str
    image: torch.Tensor  # [H, W, 3]
    target: torch.Tensor  # [H, W, 3]
    mask: torch.Tensor | None  # [H, W] bool


def _drawn(
    splats: Splats,
    views: Sequence[View],
    settings: RasterSettings,
    backend: Backend,
    exposures: Transforms,
    match: bool = False,
) -> Iterator[_Drawn]:
    settings = replace(settings, sh_degree=splats.sh_degree)
    for view in views:
        with torch.no_grad():
            image = rasterize(splats, view.camera, settings, backend=backend).color
        target = torch.from_numpy(view.target(settings.background)).to(image)
        pixels = view.mask()
        mask = None if pixels is None else torch.from_numpy(pixels).to(image.device)
        if match:
            image = matched_by_halves(view, image, target, mask, settings.background)
        else:
            image = photographed(view, image, exposures, settings.background)
        yield _Drawn(view.name, image, target, mask)


def split_metrics(scores: dict[str, ImageMetrics], name: str, split: str | None = None) -> dict[str, Any]:
    """``{name: means}``; null with the reason where the scene has no views of the split (by default ``name``)."""
    if not scores:
        return {name: None, f"{name}_reason": f"the scene has no {split or name} views"}
    return {name: mean_metrics(list(scores.values())).to_json()}


class PeakGpuMemory:
    """Peak of torch's memory on the current GPU since :meth:`reset`; 0 where the backend uses none."""

    def __init__(self, backend: Backend) -> None:
        self._used = backend.device == "cuda"

    def reset(self) -> None:
        """Start again from what is allocated now."""
        if self._used:
            torch.cuda.reset_peak_memory_stats()

    def read(self) -> int:
        """Bytes."""
        return int(torch.cuda.max_memory_allocated()) if self._used else 0


class PeakMemory:
    """Peak resident memory of this process since :meth:`reset` (Linux), or since it started (elsewhere)."""

    def reset(self) -> None:
        """Start again from what is resident now."""
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")

    def read(self) -> int:
        """Bytes."""
        with contextlib.suppress(OSError):
            for line in Path("/proc/self/status").read_text().splitlines():
                if line.startswith("VmHWM:"):
                    return int(line.split()[1]) * 1024
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return int(peak if sys.platform == "darwin" else peak * 1024)
