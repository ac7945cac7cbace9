"""The verdict on a run: a grade, the measures behind it, and advice; ``verdict.json``.

The grade is the worst one of PSNR of test views (training views if there are none), floaters and surface. Missing
measures are listed and do not change the grade.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import fmean
from typing import Any

import numpy as np

from gs2d.config import grades
from gs2d.config.grades import GOOD, POOR, USABLE
from gs2d.core.camera import Camera
from gs2d.core.json_files import write_json
from gs2d.data import Scene
from gs2d.data.subject_box import OBJECT, read_subject
from gs2d.errors import RunError
from gs2d.evaluation.hidden_points import hidden_points
from gs2d.evaluation.image_metrics import ImageMetrics
from gs2d.io.run_dir import VERDICT, RunFolder
from gs2d.meshing.fusion_bounds import backproject
from gs2d.pipeline.finish.scoring import RenderedPhotograph
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.pipeline.prepare.open_capture import FEW, placed_photographs
from gs2d.render.types import RenderOutput
from gs2d.report.sections.verdict_section import read_verdict

FORMAT = 3
NAMED = 3  # views named in a sentence; verdict.json has all
HEADLINES: Mapping[str | None, str] = {
    GOOD: "New views look like photographs of the scene.",
    USABLE: "The scene is recognisable but has visible flaws.",
    POOR: "Parts of the scene are wrong or blurred.",
    None: "Nothing was measured.",
}
UNCHECKED = "The training photographs are reproduced {}; new views were not checked."
NOT_MEASURED = "not measured"
OPAQUE = 0.5  # alpha; above, a pixel shows a surface
CLEAR = 0.9  # alpha; below, more than a tenth of the colour is background
SURFACE_PIXELS = 2000  # of a view, at which its surface is examined
SPREAD_DEPTH = 0.05  # of the mean depth; the depth that hides a sparse point (evaluation/hidden_points.py)


# -- measures ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class ViewMeasures:
    """One view of the finished splats."""

    name: str
    split: str
    psnr: float | None = None  # dB, of 8-bit images
    points: int | None = None  # sparse points visible in a test view
    hidden: int | None = None  # how many of them its rendering hides
    spread: float | None = None  # share of the opaque pixels of the subject whose surface is unclear (`SurfaceSample`)
    # Share of the pixels in which the background shows through, of a training view without alpha channel.
    transparent: float | None = None


@dataclass(frozen=True)
class Measures:
    """The input of a verdict."""

    views: tuple[ViewMeasures, ...]
    placed: int | None = None  # photographs with a camera, if `gs2d poses` created the capture
    count: int | None = None  # all photographs, in that case
    lost: tuple[str, ...] = ()  # names of the photographs without a camera


class Collector:
    """Measures each view while it is scored; pass :meth:`visit` to ``scoring.score_views``."""

    def __init__(self, scene: Scene) -> None:
        self._views: dict[str, ViewMeasures] = {}
        self._surfaces: dict[str, SurfaceSample] = {}
        self.failure: Exception | None = None  # stopped the measuring; scoring continues
        self._observed = scene.observed(guessed=False)  # None: floaters cannot be counted

    def views(self, box: np.ndarray | None = None) -> tuple[ViewMeasures, ...]:
        """Return the views measured so far; surfaces are judged in a box [2, 3], world units, or everywhere."""
        spread = {name: surface.share(box) for name, surface in self._surfaces.items()}
        return tuple(replace(view, spread=spread.get(name)) for name, view in self._views.items())

    def transparent(self) -> dict[str, Any]:
        """Return ``{"transparent": ...}`` for ``metrics.json``: the mean share, the worst view and its share."""
        shares = {view.name: view.transparent for view in self._views.values() if view.transparent is not None}
        if not shares:
            return {}
        worst = max(shares, key=shares.__getitem__)
        return {"transparent": {"part": fmean(shares.values()), "view": worst, "worst": shares[worst]}}

    def visit(self, rendered: RenderedPhotograph, scores: ImageMetrics) -> None:
        """Measure a view."""
        if self.failure is not None:
            return
        try:
            self._views[rendered.view.name] = self._measure(rendered, scores)
        except Exception as error:
            self.failure = error

    def _measure(self, rendered: RenderedPhotograph, scores: ImageMetrics) -> ViewMeasures:
        view, psnr = rendered.view, scores.psnr.value
        psnr = psnr if psnr is not None and math.isfinite(psnr) else None
        measured = ViewMeasures(view.name, rendered.split, psnr)
        if rendered.output.depth_transmittance is not None:
            self._surfaces[view.name] = SurfaceSample.of(view.camera, rendered.output)
        if rendered.split == "train" and view.alpha() is None:
            alpha = rendered.output.alpha if rendered.mask is None else rendered.output.alpha[rendered.mask]
            return replace(measured, transparent=float((alpha < CLEAR).double().mean()) if alpha.numel() else None)
        if rendered.split != "test" or self._observed is None:
            return measured
        points = self._observed.in_view(view.name, view.camera)
        hidden = hidden_points(rendered.output.depth("median").cpu().numpy(), points)
        return replace(measured, points=len(points.depth), hidden=int(hidden.sum()))


@dataclass(frozen=True, eq=False)
class SurfaceSample:
    """Some opaque pixels of a view, and whether their surface is unclear.

    There the depths of half transmittance and of the mean differ by more than ``SPREAD_DEPTH``: part of the splats is
    not on the surface, as in a faint veil in front of it. The image can be right, but the mesh tears.
    """

    center: np.ndarray  # [3] world units
    rays: np.ndarray  # [n, 3] float32; from the camera centre, with a depth of 1
    depth: np.ndarray  # [n] world units; of half transmittance
    unclear: np.ndarray  # [n] bool

    @classmethod
    def of(cls, camera: Camera, output: RenderOutput) -> SurfaceSample:
        """Sample a rendering with the transmittance depth."""
        mean, half = output.depth_mean.cpu().numpy(), output.depth("transmittance").cpu().numpy()
        rows, columns = np.nonzero(output.alpha.cpu().numpy() > OPAQUE)
        some = slice(None, None, max(1, len(rows) // SURFACE_PIXELS))
        rows, columns = rows[some], columns[some]
        mean, half = mean[rows, columns], half[rows, columns]
        rays = backproject(camera, np.ones(len(rows)), rows, columns) - camera.center
        return cls(camera.center, rays.astype(np.float32), half, np.abs(half - mean) > SPREAD_DEPTH * mean)

    def share(self, box: np.ndarray | None) -> float | None:
        """Return the share of unclear pixels, of those that see into the box [2, 3] and not past it; None of none."""
        unclear = self.unclear
        if box is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = (box[:, None] - self.center) / self.rays  # [2, n, 3], in units of depth
            enter, leave = np.nanmax(ends.min(axis=0), axis=1), np.nanmin(ends.max(axis=0), axis=1)
            unclear = unclear[(leave > np.maximum(enter, 0)) & (self.depth <= leave)]
        return float(unclear.mean()) if len(unclear) else None


# -- judging -----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Finding:
    """One measure: name, grade (None: not graded), value and meaning as text, advice, and the views concerned."""

    name: str
    grade: str | None
    figure: str
    text: str
    advice: str = ""
    views: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """A grade, a sentence, and the findings."""

    grade: str | None
    headline: str
    findings: tuple[Finding, ...]


def judge(measures: Measures) -> Verdict:
    """Return the verdict: the worst grade of image quality, floaters and surface."""
    quality = _quality(measures)
    findings = (*quality, _floaters(measures), *_surface(measures), *_placed(measures))
    graded = any(finding.grade is not None for finding in quality)
    grade = grades.worst([f.grade for f in findings if f.grade is not None]) if graded else None
    headline = HEADLINES[grade]
    if grade is not None and quality[0].grade is None:
        headline = UNCHECKED.format({GOOD: "well", USABLE: "with visible flaws", POOR: "poorly"}[grade])
    return Verdict(grade, headline, findings)


def _quality(measures: Measures) -> list[Finding]:
    """Judge the mean PSNR of test views, or of training views where none was held out."""
    test = [(view.psnr, view.name) for view in measures.views if view.split == "test" and view.psnr is not None]
    train = [view.psnr for view in measures.views if view.split == "train" and view.psnr is not None]
    trained = fmean(train) if train else None
    if not test:
        text = "All photographs were used for training. --test-every 8 holds out every eighth to check new views."
        few = measures.count is not None and measures.count < FEW
        advice = f"Take 30 or more photographs: with {measures.count}, new views were not checked." if few else ""
        new = Finding("new views", None, NOT_MEASURED, text, advice)
        if trained is None:
            return [new]
        grade = grades.TRAINING_VIEWS.grade(trained)
        advice = "" if grade == GOOD else _train_longer(trained)
        return [new, Finding("training views", grade, f"{trained:.1f} dB", "Mean PSNR of training views.", advice)]
    psnr, (low, name) = fmean(value for value, _ in test), min(test)
    grade, advice = grades.NEW_VIEWS.grade(psnr), ""
    if grade != GOOD and trained is not None and trained - psnr <= grades.OVERFIT:
        advice = _train_longer(trained)
    elif grade != GOOD or grades.NEW_VIEWS.grade(low) == POOR:
        advice = f"Take more photographs from viewpoints near {name}. Longer training does not improve it."
    figure = f"{psnr:.1f} dB" + (f", worst {low:.1f} dB" if len(test) > 1 else "")
    text = f"Mean PSNR of {len(test)} held-out photograph{'s' * (len(test) > 1)}; {name} is the worst."
    return [Finding("new views", grade, figure, text, advice, (name,))]


def _train_longer(psnr: float) -> str:
    return (
        f"Training views have only {psnr:.1f} dB. Train longer or on larger images (--quality, or --schedule-scale and "
        "--downscale), unless something moved or the light changed between the photographs."
    )


def _floaters(measures: Measures) -> Finding:
    """Judge the share of sparse points of test views that the rendering hides.

    If every test view is good, the limit is higher: mirrors and glass have points behind their surface.
    """
    shares = {view.name: (view.hidden or 0, view.points) for view in measures.views if view.points}
    shown = sum(points for _, points in shares.values())
    if not shown:
        text = "Needs test views and the sparse points that each photograph shows."
        return Finding("floaters", None, NOT_MEASURED, text)
    new = [view.psnr for view in measures.views if view.split == "test" and view.psnr is not None]
    limit = grades.BEHIND if new and grades.NEW_VIEWS.grade(min(new)) == GOOD else grades.FLOATERS
    hidden = sum(hidden for hidden, _ in shares.values())
    grade = limit.grade(hidden / shown)
    bad = {name: part / points for name, (part, points) in shares.items() if limit.grade(part / points) != GOOD}
    views = tuple(sorted(bad, key=lambda name: -bad[name]))
    advice = "" if grade == GOOD else f"Take more photographs near {_some(views)}, in the same light."
    text = "Sparse points of new views that the rendering hides behind floaters or a misplaced surface."
    return Finding("floaters", grade, f"{100 * hidden / shown:.1f} % of {shown:,} points", text, advice, views)


def _surface(measures: Measures) -> list[Finding]:
    """Report a surface that is unclear in many pixels; nothing if it is clear or was not measured."""
    shares = {view.name: view.spread for view in measures.views if view.spread is not None}
    part = fmean(shares.values()) if shares else 0.0
    grade = grades.SPREAD.grade(part)
    if grade == GOOD:
        return []
    views = tuple(sorted(shares, key=lambda name: -shares[name]))[:NAMED]
    text = "Pixels in which splats lie in front of the surface or behind it, so that the mesh can tear."
    advice = f"Look at mesh.ply near {_some(views)}; if it is torn, train with another --seed or longer."
    return [Finding("surface", grade, f"{100 * part:.0f} % unclear", text, advice, views)]


def _placed(measures: Measures) -> list[Finding]:
    """Report the photographs without a camera."""
    placed, count, lost = measures.placed, measures.count, measures.lost
    if placed is None or not count:
        return []
    text = "Photographs with a camera" + (f"; without one: {_some(lost)}." if lost else ".")
    advice = ""
    if placed < grades.PLACED * count and lost:
        advice = f"Take more photographs between {_some(lost)} and the others, each overlapping the previous one."
    return [Finding("placed", None, f"{placed} of {count} photographs", text, advice, lost)]


def _some(names: Sequence[str]) -> str:
    """Return the first names as text."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


# -- verdict.json ------------------------------------------------------------------------------------------------------
def write_verdict(run: RunFolder, trained: Trained, collected: Collector) -> dict[str, Any] | None:
    """Judge a run, write ``verdict.json``, and return the verdict; without newly measured views the earlier one.

    Raises RunError if the views were scored but never measured.
    """
    if collected.failure is not None:
        raise collected.failure
    subject = read_subject(run.path) if trained.protocol.fusion.subject else None
    views = collected.views(subject.box if subject is not None and subject.kind == OBJECT else None)
    if not views:
        if not run.file(VERDICT).exists():
            raise RunError("the run was interrupted between scoring and measuring; `gs2d evaluate RUN` measures it")
        return read_verdict(run.path)
    measures = Measures(views, *placed_photographs(trained.scene.root))
    verdict = asdict(judge(measures))
    write_json(run.file(VERDICT), {"format": FORMAT, "verdict": verdict, "measured": asdict(measures)})
    return verdict
