"""Image metrics of a scene of splats over many views, and how much memory it took."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gs2d.core.splats import Splats
from gs2d.data import View
from gs2d.evaluation.image_metrics import ImageMetrics, image_metrics, mean_metrics, psnr_float
from gs2d.evaluation.lpips import Lpips
from gs2d.pipeline.prepare.run_appearance import matched_by_halves, photographed
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.training.events import OnEvent, Phase, Step


@dataclass(frozen=True, eq=False)
class SeenView:
    """A view that was rendered, beside its photograph: what whoever looks at it needs, so that it is rendered once.

    Attributes
    ----------
    view : View
    split : str
        "train", "test", or "" where nobody said.
    output : RenderOutput
        As the scene is, without its distortion.
    image : Tensor [H, W, 3]
        Its colour in the exposure of the photograph; may exceed 1.
    target : Tensor [H, W, 3]
        The photograph over the background, in [0, 1].
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    """

    view: View
    split: str
    output: RenderOutput
    image: torch.Tensor
    target: torch.Tensor
    mask: torch.Tensor | None


CLEAR = 0.9  # alpha below which a pixel of an opaque photograph lets the background through


def transparent_part(seen: SeenView) -> float | None:
    """Return the part of a view's pixels whose alpha is below 0.9; None where the photograph has an alpha channel."""
    if seen.view.alpha() is not None:
        return None
    clear = seen.output.alpha < CLEAR
    return float((clear if seen.mask is None else clear[seen.mask]).float().mean())


def transparent_entry(parts: Mapping[str, float]) -> dict[str, Any]:
    """Return the mean of ``transparent_part`` over the views, by name, and the worst view, for ``metrics.json``."""
    if not parts:
        return {}
    worst = max(parts, key=parts.__getitem__)
    return {"transparent": {"part": sum(parts.values()) / len(parts), "view": worst, "worst": parts[worst]}}


Visitor = Callable[[SeenView, ImageMetrics], None]
"""Is shown each view with its scores while it is in memory, and keeps what it needs of it, not the view."""


def score_views(
    splats: Splats,
    views: Sequence[View],
    settings: RasterSettings,
    backend: Backend,
    *,
    name: str,
    on_event: OnEvent,
    lpips: Lpips | None = None,
    match: bool = False,
    split: str = "",
    visitors: Sequence[Visitor] = (),
) -> dict[str, ImageMetrics]:
    """Image metrics of each view by its name; pixels that the view's mask leaves out count nowhere.

    A view is rendered as its photograph shows the scene, as far as its ``appearance`` is known; with ``match`` by
    :func:`~gs2d.pipeline.prepare.run_appearance.matched_by_halves`.
    ``visitors`` see each view, named ``split``.
    """
    on_event(Phase(name, len(views)))
    scores: dict[str, ImageMetrics] = {}
    for done, seen in enumerate(_seen(splats, views, settings, backend, match, split), start=1):
        metrics = image_metrics(seen.image, seen.target, seen.mask, backend=backend, lpips=lpips)
        scores[seen.view.name] = metrics
        for visit in visitors:
            visit(seen, metrics)
        on_event(Step(done))
    return scores


def mean_psnr(
    splats: Splats,
    views: Sequence[View],
    settings: RasterSettings,
    backend: Backend,
) -> float | None:
    """Mean ``psnr_float`` of the views that have one, as by :func:`score_views`, without the other metrics."""
    values = [psnr_float(s.image, s.target, s.mask) for s in _seen(splats, views, settings, backend)]
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def _seen(
    splats: Splats,
    views: Sequence[View],
    settings: RasterSettings,
    backend: Backend,
    match: bool = False,
    split: str = "",
) -> Iterator[SeenView]:
    settings = replace(settings, sh_degree=splats.sh_degree, with_distortion=False)
    for view in views:
        with torch.no_grad():
            output = rasterize(splats, view.camera, settings, backend=backend)
        target = torch.from_numpy(view.target(settings.background)).to(output.color)
        pixels = view.mask()
        mask = None if pixels is None else torch.from_numpy(pixels).to(target.device)
        if match:
            image = matched_by_halves(view, output.color, target, mask, settings.background)
        else:
            image = photographed(view, output.color, settings.background)
        yield SeenView(view, split, output, image, target, mask)


def split_metrics(
    scores: dict[str, ImageMetrics], name: str, split: str | None = None, *, of: int | None = None
) -> dict[str, Any]:
    """``{name: means}``; null with the reason where the scene has no views of the split (by default ``name``).

    Where fewer views than the split has, ``of``, were scored, ``views`` says how many.
    """
    if not scores:
        return {name: None, f"{name}_reason": f"the scene has no {split or name} views"}
    some = {} if of is None or len(scores) == of else {"views": len(scores)}
    return {name: {**mean_metrics(list(scores.values())).to_json(), **some}}


def is_partial(entry: Mapping[str, Any]) -> bool:
    """Whether the scores of a stage in ``metrics.json`` are of some of the views only."""
    return any("views" in (entry.get(split) or {}) for split in ("train", "test"))


def evenly(views: Sequence[View], most: int) -> Sequence[View]:
    """At most so many of the views, from all along their order."""
    count = min(most, len(views))
    return [views[(2 * i + 1) * len(views) // (2 * count)] for i in range(count)]


class PeakGpuMemory:
    """Peak of torch's memory on the current GPU since :meth:`reset`; 0 where the backend uses none."""

    def __init__(self, backend: Backend) -> None:
        self._used = torch.device(backend.device).type == "cuda"

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
