"""What a verdict is judged by: each view beside its photograph, angles between cameras, and placed photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from gs2d.config.serialize import decode
from gs2d.core.json_files import read_json
from gs2d.core.transforms import focus_point
from gs2d.data import Scene, View
from gs2d.errors import RecipeError, RunError
from gs2d.evaluation.hidden_points import hidden_points
from gs2d.evaluation.images import ImageMetrics
from gs2d.pipeline.finish.scoring import SeenView
from gs2d.sfm.workspace import POSES_JSON

FACING = math.cos(math.radians(60.0))  # a camera looks at the subject where it is within this of its axis


@dataclass(frozen=True)
class ViewMeasures:
    """One view of the finished splats; None where a value does not exist.

    Attributes
    ----------
    name, split : str
    psnr : float or None
        dB, of 8-bit images.
    blur : float or None
        :func:`blur_of` the photograph, px at the image size of training.
    points, hidden : int or None
        Sparse points that a test view shows, and those of them that its rendering hides.
    next : str or None
        The other training view whose camera is nearest in direction from the subject.
    degrees : float or None
        The angle to that camera about the subject.
    """

    name: str
    split: str
    psnr: float | None = None
    blur: float | None = None
    points: int | None = None
    hidden: int | None = None
    next: str | None = None
    degrees: float | None = None


@dataclass(frozen=True)
class Measures:
    """All that a verdict is judged by.

    Attributes
    ----------
    views : tuple of ViewMeasures
    placed, count : int or None
        Photographs with a camera and all photographs, where ``gs2d poses`` found the cameras.
    lost : tuple of str
        Names of the photographs without a camera.
    """

    views: tuple[ViewMeasures, ...]
    placed: int | None = None
    count: int | None = None
    lost: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return plain values; :func:`measures_from_json` reads them."""
        return asdict(self)


def measures_from_json(data: Any) -> Measures:
    """Read what ``Measures.to_json`` wrote.

    Raises
    ------
    RunError
        If ``data`` is something else.
    """
    try:
        found: Measures = decode(data, Measures, "measured")
        return found
    except RecipeError as error:
        raise RunError(f"expected measures as gs2d writes them, got another entry ({error})") from error


class Collector:
    """Measures each view while it is scored; `visit` is for `score_views`.

    Attributes
    ----------
    failure : Exception or None
        What stopped the measuring; scoring goes on.
    """

    def __init__(self, scene: Scene) -> None:
        self._views: dict[str, ViewMeasures] = {}
        self.failure: Exception | None = None
        self._observed = scene.observed(guessed=False)  # None: there are no floaters to count

    @property
    def views(self) -> tuple[ViewMeasures, ...]:
        """The views measured so far."""
        return tuple(self._views.values())

    def visit(self, seen: SeenView, scores: ImageMetrics) -> None:
        """Measure a view."""
        if self.failure is not None:
            return
        try:
            self._views[seen.view.name] = self._measure(seen, scores)
        except Exception as error:
            self.failure = error

    def _measure(self, seen: SeenView, scores: ImageMetrics) -> ViewMeasures:
        view, psnr = seen.view, scores.psnr.value
        psnr = psnr if psnr is not None and math.isfinite(psnr) else None
        found = ViewMeasures(name=view.name, split=seen.split, psnr=psnr, blur=blur_of(seen.target, seen.mask))
        if seen.split != "test" or self._observed is None:
            return found
        points = self._observed.in_view(view.name, view.camera)
        hidden = hidden_points(seen.output.depth("median").cpu().numpy(), points).hidden
        return replace(found, points=len(points.depth), hidden=hidden)


def blur_of(image: Tensor, mask: Tensor | None = None) -> float | None:
    """Return the width of the sharpest edges of an image, px: the standard deviation of an equivalent Gaussian blur.

    A step that is blurred with a Gaussian of s px has 2 s^2 times the energy in its first differences that it has in
    its second ones, whatever its height. The energies are summed over the image along x and along y, and the larger
    result counts: motion blurs one way.

    Parameters
    ----------
    image : Tensor [H, W, 3]
    mask : Tensor [H, W] bool, optional
        Pixels that count (default: all).

    Returns
    -------
    float or None
        None where the image has no edges, or is too small.
    """
    grey, widths = image.float().mean(dim=-1), []
    valid = grey >= 0 if mask is None else mask
    for light, counts in ((grey, valid), (grey.T, valid.T)):
        first = light[:, 1:] - light[:, :-1]
        inside = counts[:, 2:] & counts[:, 1:-1] & counts[:, :-2]
        slopes = float((first[:, 1:] ** 2)[inside].sum() + (first[:, :-1] ** 2)[inside].sum()) / 2
        bends = float(((first[:, 1:] - first[:, :-1]) ** 2)[inside].sum())
        if slopes > 0 and bends > 0:
            widths.append(math.sqrt(slopes / bends / 2))
    return max(widths) if widths else None


def neighbours_of(
    train: Sequence[View], test: Sequence[View], subject: np.ndarray | None = None
) -> dict[str, tuple[str, float]]:
    """Return for each view the nearest other training camera in direction from the subject, and the angle in degrees.

    Empty where less than half of the cameras look at the subject, as in a room that is photographed from its middle.

    Parameters
    ----------
    train, test : sequence of View
    subject : ndarray [3] world units, optional
        Its centre (default: where the axes meet).
    """
    cameras = [view.camera for view in train]
    if len(cameras) < 2:
        return {}
    subject = focus_point(cameras) if subject is None else subject
    arms = {view.name: view.camera.center - subject for view in (*train, *test)}
    arms = {name: arm / max(float(np.linalg.norm(arm)), 1e-12) for name, arm in arms.items()}
    names, directions = [view.name for view in train], np.stack([arms[view.name] for view in train])
    if sum(float(-arms[view.name] @ view.camera.forward) > FACING for view in train) < len(train) / 2:
        return {}
    found = {}
    for name, arm in arms.items():
        cosines = np.clip(directions @ arm, -1.0, 1.0)
        if name in names:
            cosines[names.index(name)] = -2.0
        best = int(cosines.argmax())
        found[name] = (names[best], math.degrees(math.acos(cosines[best])))
    return found


def placed_images(capture: Path | None) -> tuple[int | None, int | None, tuple[str, ...]]:
    """Return the numbers of photographs with a camera and of all, and the names without one; None where not known."""
    path = None if capture is None else capture / POSES_JSON
    if path is None or not path.is_file():
        return None, None, ()
    data = read_json(path)
    try:
        lost = tuple(str(row["source"]) for row in data["photographs"] if not row["placed"])
        return int(data["placed"]), int(data["count"]), lost
    except (KeyError, TypeError, ValueError, OverflowError):
        return None, None, ()  # another program's file of this name


def measure(scene: Scene, views: tuple[ViewMeasures, ...], subject: np.ndarray | None) -> Measures:
    """Return the measures of a run whose views were measured; ``subject`` [3] as in :func:`neighbours_of`."""
    found = neighbours_of(scene.train, scene.test, subject)
    near = {name: {"next": other, "degrees": degrees} for name, (other, degrees) in found.items()}
    rows = tuple(replace(view, **near.get(view.name, {})) for view in views)  # type: ignore[arg-type]
    return Measures(rows, *placed_images(scene.root))
