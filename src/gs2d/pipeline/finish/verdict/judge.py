"""The verdict on a run in words: a grade, findings, and what to do or to photograph next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean, median
from typing import Any

from gs2d.config import grades
from gs2d.config.grades import GOOD, LIMITS, POOR, USABLE
from gs2d.pipeline.finish.verdict.measures import Measures

FORMAT = 2
NAMED = 3  # views that a sentence names; verdict.json has all
HEADLINES: Mapping[str | None, str] = {
    GOOD: "New views look like photographs of the scene.",
    USABLE: "The scene is recognisable but has visible flaws.",
    POOR: "Parts of the scene are wrong or foggy.",
    None: "Nothing was measured.",
}
UNCHECKED = "The training photographs are reproduced {}; new views were not checked."
NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Finding:
    """One measure and what it means.

    Attributes
    ----------
    name : str
    grade : str or None
        One of ``grades.GRADES``; None: not graded, or not measured.
    figure : str
        The value in a few words.
    text : str
        A sentence or two.
    advice : str
        What to do next; empty where nothing would help.
    views : tuple of str
        The views that it is about.
    """

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

    def to_json(self) -> dict[str, Any]:
        """Return plain values, as in ``verdict.json``."""
        return {"format": FORMAT, **asdict(self)}


def judge(measures: Measures) -> Verdict:
    """Return the verdict on what was measured: the worst grade of new views, floaters and placed photographs.

    A measure without a value is reported and does not change the grade. What could be better in the photographs is
    reported only where the result is not good.
    """
    findings = [*_views(measures), *_floaters(measures), *_placed(measures)]
    pictures = [finding.grade for finding in findings if finding.name in (grades.NEW, grades.TRAINED)]
    grade = grades.worst(f.grade for f in findings if f.grade is not None) if any(pictures) else None
    headline = HEADLINES[grade]
    if grade is not None and findings[0].grade is None:
        headline = UNCHECKED.format({GOOD: "well", USABLE: "with visible flaws", POOR: "poorly"}[grade])
    if grade in (USABLE, POOR):
        findings += [*_overlap(measures), *_blur(measures)]
    return Verdict(grade, headline, tuple(findings))


def _views(measures: Measures) -> list[Finding]:
    """Judge the PSNR of test views, or of training views where none was held out."""
    test = [view for view in measures.views if view.split == "test" and view.psnr is not None]
    train = [view.psnr for view in measures.views if view.split == "train" and view.psnr is not None]
    trained = fmean(train) if train else None
    if not test:
        text = "All photographs trained; --test-every 8 holds every eighth out and scores it."
        new = Finding(grades.NEW, None, NOT_MEASURED, text)
        if trained is None:
            return [new]
        grade = LIMITS[grades.TRAINED].grade(trained)
        advice = "" if grade == GOOD else _train_longer(trained)
        text = "Mean PSNR of the photographs that trained."
        return [new, Finding(grades.TRAINED, grade, f"{trained:.1f} dB", text, advice)]
    psnr, low = fmean(view.psnr or 0.0 for view in test), min(test, key=lambda view: view.psnr or 0.0)
    grade, advice = LIMITS[grades.NEW].grade(psnr), ""
    if grade != GOOD and trained is not None and LIMITS[grades.GAP].grade(trained - psnr) == GOOD:
        advice = _train_longer(trained)
    elif grade != GOOD or LIMITS[grades.NEW].grade(low.psnr or 0.0) == POOR:
        advice = f"Take more photographs near what {low.name} shows; longer training will not help there."
    text = f"Mean PSNR of the {_count(len(test), 'photograph')} that did not train; the worst is {low.name}."
    figure = f"{psnr:.1f} dB" + (f", worst {low.psnr:.1f} dB" if len(test) > 1 else "")
    return [Finding(grades.NEW, grade, figure, text, advice, (low.name,))]


def _train_longer(psnr: float) -> str:
    return (
        f"Training views have {psnr:.1f} dB only: train longer or on larger images (--quality, or --schedule-scale and "
        "--downscale), unless something moved or the light changed while you photographed."
    )


def _floaters(measures: Measures) -> list[Finding]:
    """Judge the sparse points of test views that something nearer hides in the rendering.

    Where every new view is good, what hides them is no fog: mirrors and glass have points behind their surface.
    """
    rows = [view for view in measures.views if view.hidden is not None and view.points]
    shown, hidden = sum(view.points or 0 for view in rows), sum(view.hidden or 0 for view in rows)
    if not shown:
        text = "Needs test views, and a capture that says which sparse points its photographs show."
        return [Finding(grades.FLOATERS, None, NOT_MEASURED, text)]
    rate = {view.name: (view.hidden or 0) / (view.points or 1) for view in rows}
    new = [view.psnr for view in measures.views if view.split == "test" and view.psnr is not None]
    clear = bool(new) and LIMITS[grades.NEW].grade(min(new)) == GOOD
    limit = LIMITS[grades.BEHIND if clear else grades.FLOATERS]
    grade = limit.grade(hidden / shown)
    views = tuple(name for name in sorted(rate, key=lambda n: -rate[n]) if limit.grade(rate[name]) != GOOD)
    text = "Sparse points of new views that something nearer hides in the rendering: floaters or misplaced surfaces."
    advice = "" if grade == GOOD else f"Photograph from near {_some(views)}, and keep the light as it is."
    return [Finding(grades.FLOATERS, grade, f"{100 * hidden / shown:.1f} % of {shown:,} points", text, advice, views)]


def _placed(measures: Measures) -> list[Finding]:
    if measures.placed is None or not measures.count:
        return []
    grade, lost = LIMITS[grades.PLACED].grade(measures.placed / measures.count), measures.lost
    text = "Only photographs with a camera are used" + (f"; without one: {_some(lost)}." if lost else ".")
    advice = ""
    if grade != GOOD and lost:
        advice = f"Take more photographs between {_some(lost)} and the others, each overlapping the one before."
    return [Finding(grades.PLACED, grade, f"{measures.placed} of {measures.count} photographs", text, advice, lost)]


def _overlap(measures: Measures) -> list[Finding]:
    """Name the widest gaps between neighbouring cameras."""
    apart = [(v.degrees, v.name, v.next) for v in measures.views if v.degrees is not None and v.next is not None]
    limit = LIMITS[grades.ANGLE]
    pairs = {frozenset(row[1:]): row for row in sorted(apart) if limit.grade(row[0]) != GOOD}  # each pair once
    if not pairs:
        return []
    shown = sorted(pairs.values(), reverse=True)[:NAMED]
    places = "; ".join(f"{name} and {near} ({degrees:.0f} degrees)" for degrees, name, near in shown)
    figure = f"{median(degrees for degrees, *_ in apart):.0f} degrees between neighbours"
    text = f"{_count(len(pairs), 'gap')} between cameras exceed {limit.good:.0f} degrees about the subject."
    advice = f"Photograph from between {places}, in steps of 10 degrees."
    return [Finding(grades.ANGLE, None, figure, text, advice, tuple(name for _, name, _ in shown))]


def _blur(measures: Measures) -> list[Finding]:
    """Name photographs whose edges are wider than those of the median photograph."""
    widths = {view.name: view.blur for view in measures.views if view.blur is not None}
    usual = median(widths.values()) if widths else 1.0
    blurred = [name for name, width in widths.items() if LIMITS[grades.BLUR].grade(width / usual) != GOOD]
    if not blurred:
        return []
    views = tuple(sorted(blurred, key=lambda name: -widths[name]))
    text = f"Their edges are wider than {LIMITS[grades.BLUR].good * usual:.1f} px at the image size of training."
    advice = f"Leave out {_some(views)}, or take them again with more light or a steadier hand."
    return [Finding(grades.BLUR, None, f"{len(views)} of {len(widths)} photographs", text, advice, views)]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


def _some(names: Sequence[str]) -> str:
    """Return the first names in words."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


__all__ = ["Finding", "Verdict", "judge"]
