"""What a verdict is about: each view beside its photograph, the cameras around the subject, what was placed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.config.serialize import decode
from gs2d.core.camera import Camera
from gs2d.core.json_files import read_json
from gs2d.core.transforms import focus_point, up_direction
from gs2d.data import Scene, View
from gs2d.errors import RecipeError, RunError
from gs2d.evaluation.hidden_points import hidden_points
from gs2d.evaluation.images import ImageMetrics, psnr_float
from gs2d.pipeline.exposure import GREY, matched_by_halves, over
from gs2d.pipeline.scoring import SeenView
from gs2d.render.exposure import fit_exposure
from gs2d.sfm.workspace import POSES_JSON

FACING = math.cos(math.radians(60.0))  # a camera looks at the subject where it is within this of its axis


@dataclass(frozen=True)
class ViewMeasures:
    """One view of the finished splats; None where there is no such figure.

    Attributes
    ----------
    name, split : str
    psnr : float or None
        dB, of 8-bit pictures.
    psnr_matched : float or None
        dB, of a test view whose colours are matched, each half by what fits the other half.
    stops : float or None
        How much brighter the photograph is than the rendering of the scene, as factors of two.
    blur : float or None
        :func:`blur_of` the photograph, px at the size of training.
    points, hidden : int or None
        Sparse points that the view shows, and those of them that its rendering hides (test views only).
    """

    name: str
    split: str
    psnr: float | None = None
    psnr_matched: float | None = None
    stops: float | None = None
    blur: float | None = None
    points: int | None = None
    hidden: int | None = None


@dataclass(frozen=True)
class Neighbour:
    """How far a camera is from the next training camera about the subject, degrees."""

    name: str
    next: str
    degrees: float


@dataclass(frozen=True)
class Measures:
    """All that a verdict is judged by.

    Attributes
    ----------
    views : tuple of ViewMeasures
    neighbours : tuple of Neighbour
        Of each view; empty where the cameras do not look at something common.
    around : float or None
        Degrees of the circle about the subject in which there are photographs.
    placed, count : int or None
        Photographs with a place, of so many, where ``gs2d poses`` found the cameras.
    lost : tuple of str
        Names of the others.
    learns_exposure : bool
        Whether the run has learned an exposure for each photograph.
    """

    views: tuple[ViewMeasures, ...]
    neighbours: tuple[Neighbour, ...] = ()
    around: float | None = None
    placed: int | None = None
    count: int | None = None
    lost: tuple[str, ...] = field(default=())
    learns_exposure: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return plain values; :func:`measures_from_json` reads them."""
        return asdict(self)


def measures_from_json(data: Any) -> Measures:
    """Read what ``Measures.to_json`` wrote.

    Raises
    ------
    RunError
        Something else.
    """
    try:
        found: Measures = decode(data, Measures, "measured")
        return found
    except RecipeError as error:
        raise RunError(f"expected measures as gs2d writes them, got another entry ({error})") from error


class Collector:
    """Measures each view while it is scored; its :meth:`visit` is for :func:`~gs2d.pipeline.scoring.score_views`."""

    def __init__(self, scene: Scene, background: tuple[float, float, float]) -> None:
        self._background = background
        self._views: dict[str, ViewMeasures] = {}
        self._failure: Exception | None = None
        self._observed = scene.observed(guessed=False)  # None: there is no such figure

    @property
    def views(self) -> tuple[ViewMeasures, ...]:
        """What was measured so far."""
        return tuple(self._views.values())

    @property
    def failure(self) -> Exception | None:
        """What stopped the measuring: not the scoring, which goes on."""
        return self._failure

    def visit(self, seen: SeenView, scores: ImageMetrics) -> None:
        """Measure a view."""
        if self._failure is not None:
            return
        try:
            self._measure(seen, scores)
        except Exception as error:
            self._failure = error

    def _measure(self, seen: SeenView, scores: ImageMetrics) -> None:
        view, is_test = seen.view, seen.split == "test"
        cover = over(view, seen.output.color, self._background)
        pixels = torch.ones_like(seen.target[..., 0], dtype=torch.bool) if seen.mask is None else seen.mask.clone()
        if cover:
            pixels &= cover[0] > 0
        transform = fit_exposure(seen.output.color, seen.target, pixels, *cover)
        shown = hidden = matched = None
        if is_test:
            image = matched_by_halves(view, seen.output.color, seen.target, seen.mask, self._background)
            matched = _finite(psnr_float(image, seen.target, seen.mask))
        if self._observed is not None:
            points = self._observed.in_view(view.name, view.camera)
            shown = len(points.depth)
            if is_test:
                hidden = hidden_points(seen.output.depth("median").cpu().numpy(), points).hidden
        self._views[view.name] = ViewMeasures(
            name=view.name,
            split=seen.split,
            psnr=_finite(scores.psnr.value),
            psnr_matched=matched,
            stops=_stops(transform),
            blur=blur_of(seen.target, pixels),
            points=shown,
            hidden=hidden,
        )


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _stops(transform: Tensor) -> float | None:
    """Return what a transform does to middle grey, as factors of two."""
    grey = float((GREY * transform[:, :3].sum(dim=1) + transform[:, 3]).mean()) / GREY
    return math.log2(grey) if grey > 0 else None


def blur_of(image: Tensor, pixels: Tensor | None = None) -> float | None:
    """Return how wide the sharpest edges of a picture are, px: the standard deviation of a blur that makes them so.

    A step that is blurred with a Gaussian of s px has 2 s^2 times the energy in its first differences that it has in
    its second ones, whatever its height. The energies are summed over the picture along x and along y, and the larger
    result counts: a photograph that was moved is blurred one way.

    Parameters
    ----------
    image : Tensor [H, W, 3]
    pixels : Tensor [H, W] bool, optional
        Those that count; None: all.

    Returns
    -------
    float or None
        None where the picture has no edges, or is too small.
    """
    grey = image.float().mean(dim=-1)
    valid = torch.ones_like(grey, dtype=torch.bool) if pixels is None else pixels
    widths = []
    for light, counts in ((grey, valid), (grey.T, valid.T)):
        first = light[:, 1:] - light[:, :-1]
        second = first[:, 1:] - first[:, :-1]
        inside = counts[:, 2:] & counts[:, 1:-1] & counts[:, :-2]
        slopes = float((first[:, 1:] ** 2)[inside].sum() + (first[:, :-1] ** 2)[inside].sum()) / 2
        bends = float((second**2)[inside].sum())
        if slopes > 0 and bends > 0:
            widths.append(math.sqrt(slopes / bends / 2))
    return max(widths) if widths else None


def neighbours_of(
    train: Sequence[View], test: Sequence[View], subject: np.ndarray | None = None
) -> tuple[tuple[Neighbour, ...], float | None]:
    """Find for each view the training camera nearest in direction from the subject, and how much of the circle is seen.

    Where less than half of the cameras look at the subject, as in a room that is photographed from its middle, there is
    no such thing.

    Parameters
    ----------
    train, test : sequence of View
    subject : ndarray [3] world units, optional
        Its middle; None: where the axes meet.

    Returns
    -------
    tuple of Neighbour, float or None
        The second: degrees about the axis that is up.
    """
    cameras = [view.camera for view in train]
    if len(cameras) < 2:
        return (), None
    subject = focus_point(cameras) if subject is None else subject
    arms = {view.name: _arm(view.camera, subject) for view in (*train, *test)}
    facing = [float(-arms[view.name] @ view.camera.forward) > FACING for view in train]
    if sum(facing) < len(facing) / 2:
        return (), None
    names, directions = [view.name for view in train], np.stack([arms[view.name] for view in train])
    found = []
    for view in (*train, *test):
        cosines = np.clip(directions @ arms[view.name], -1.0, 1.0)
        if view.name in names:
            cosines[names.index(view.name)] = -2.0
        best = int(cosines.argmax())
        found.append(Neighbour(view.name, names[best], math.degrees(math.acos(min(max(cosines[best], -1.0), 1.0)))))
    return tuple(found), _degrees_around(directions, up_direction(cameras))


def _arm(camera: Camera, subject: np.ndarray) -> np.ndarray:
    arm = camera.center - subject
    return np.asarray(arm / max(float(np.linalg.norm(arm)), 1e-12))


def _degrees_around(directions: np.ndarray, up: np.ndarray) -> float:
    """Return the circle less the widest stretch of it without a camera."""
    across = np.linalg.svd(up[None])[2][1:]  # [2, 3], the plane across what is up
    flat = directions @ across.T
    angles = np.sort(np.degrees(np.arctan2(flat[:, 1], flat[:, 0])))
    gaps = np.diff(np.append(angles, angles[0] + 360.0))
    return float(360.0 - gaps.max())


def placed_images(capture: Path | None) -> tuple[int | None, int | None, tuple[str, ...]]:
    """Return how many photographs have a place, of how many, and the names of the others; None where nobody knows."""
    path = None if capture is None else capture / POSES_JSON
    if path is None or not path.is_file():
        return None, None, ()
    data = read_json(path)
    try:
        lost = tuple(str(row["source"]) for row in data["photographs"] if not row["placed"])
        return int(data["placed"]), int(data["count"]), lost
    except (KeyError, TypeError, ValueError, OverflowError):
        return None, None, ()  # another program's file of this name


def measure(
    scene: Scene, views: tuple[ViewMeasures, ...], *, subject: np.ndarray | None, learns_exposure: bool
) -> Measures:
    """Return the measures of a run whose views were measured; ``subject`` [3] as in :func:`neighbours_of`."""
    neighbours, around = neighbours_of(scene.train, scene.test, subject)
    placed, count, lost = placed_images(scene.root)
    return Measures(views, neighbours, around, placed, count, lost, learns_exposure)
