"""The verdict on a run in words: findings with a grade each, and what to do or to photograph next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from statistics import median, quantiles
from typing import Any

from gs2d.config import grades
from gs2d.config.grades import GOOD, USABLE
from gs2d.pipeline.verdict.measures import Measures, Neighbour

FORMAT = 1
NAMED = 3  # views that a sentence names; verdict.json has all
HEADLINES = {
    GOOD: "New views look like photographs of the scene.",
    USABLE: "The scene is recognisable, with flaws that one sees.",
    grades.POOR: "The scene is poor: the findings say why.",
}
RESULTS = ("new views", "training views", "worst view", "gap", "floaters")  # the others are about the photographs


@dataclass(frozen=True)
class Finding:
    """One figure, what it means, and what to do.

    Attributes
    ----------
    name : str
    grade : str or None
        One of ``grades.GRADES``; None: not graded, or not known.
    figure : str
        The figure in a few words.
    text : str
        What it says, a sentence or two.
    advice : str
        What to do next; empty where nothing is to be done.
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
    """The whole: a grade, a sentence, findings."""

    grade: str | None
    headline: str
    findings: tuple[Finding, ...]

    def to_json(self) -> dict[str, Any]:
        """Return plain values, as in ``verdict.json``."""
        return {"format": FORMAT, **asdict(self)}


def judge(measures: Measures) -> Verdict:
    """Return the verdict on what was measured.

    The grade is the worst of the findings about the result. It is ``usable`` at best where no view was held out, and
    where a finding about the photographs is poor.
    """
    judged: Sequence[Callable[[Measures], Finding | None]] = (
        _placed, _coverage, _overlap, _new_views, _training_views, _worst_view, _gap, _floaters, _exposure, _blur
    )  # fmt: skip
    findings = tuple(finding for finding in (rule(measures) for rule in judged) if finding is not None)
    grade = grades.worst(f.grade for f in findings if f.name in RESULTS and f.grade is not None)
    unchecked = not any(view.split == "test" for view in measures.views)
    if grade == GOOD and (unchecked or any(f.grade == grades.POOR for f in findings)):
        grade = USABLE
    headline = "Nothing was measured." if grade is None else HEADLINES[grade]
    if unchecked and grade is not None:
        headline += " No new view was checked: all photographs trained."
    return Verdict(grade, headline, findings)


# -- findings ----------------------------------------------------------------------------------------------------------
def _placed(measures: Measures) -> Finding | None:
    placed, count = measures.placed, measures.count
    if placed is None or not count:
        return None
    grade = grades.PLACED.grade(placed / count)
    text = "Only photographs whose place was found take part."
    advice = ""
    if measures.lost:
        advice = (
            f"No place for {_some(measures.lost)}: take more photographs between these and the others, each showing "
            "most of what the one before shows."
        )
    return Finding("placed", grade, f"{placed} of {count} photographs", text, advice, measures.lost)


def _coverage(measures: Measures) -> Finding | None:
    if measures.around is None:
        return None
    around = measures.around
    text, advice = "There are photographs from all around.", ""
    if around < grades.ALL_AROUND:
        text = "The side without photographs is not known: do not look from there."
        advice = "For the other side, go on around the subject; for a facade or a relief this is enough."
    return Finding("coverage", None, f"{around:.0f} of 360 degrees", text, advice)


def _overlap(measures: Measures) -> Finding | None:
    apart = {n.name: n for n in measures.neighbours}
    points = {view.name: view.points for view in measures.views if view.points is not None}
    if not apart and not points:
        return None
    middle = median(points.values()) if points else 0.0
    few = max(grades.FEW_POINTS, grades.FEW_OF_MEDIAN * middle)
    far = [name for name, n in apart.items() if n.degrees > grades.WIDE_ANGLE]
    bare = [name for name, shown in points.items() if shown < few]
    thin = tuple(dict.fromkeys([*far, *bare]))
    parts = []
    if apart:
        parts.append(f"views are {median(n.degrees for n in apart.values()):.0f} degrees apart")
    if points:
        parts.append(f"{middle:,.0f} points a view")
    total = len(dict.fromkeys([*apart, *points]))
    grade = grades.THIN.grade(len(thin) / total)
    text = "Each view is near to others, and shares points with them."
    if thin:
        text = (
            f"{len(thin)} of {total} views are thin: the next camera is more than {grades.WIDE_ANGLE:.0f} degrees "
            f"away, or fewer than {few:.0f} points are seen."
        )
    return Finding("overlap", grade, ", ".join(parts), text, _image_between(far, bare, apart), thin)


def _image_between(far: Sequence[str], bare: Sequence[str], apart: dict[str, Neighbour]) -> str:
    if far:
        widest = sorted(far, key=lambda name: -apart[name].degrees)
        pairs = {frozenset((name, apart[name].next)): apart[name] for name in reversed(widest)}  # each once
        shown = sorted(pairs.values(), key=lambda n: -n.degrees)[:NAMED]
        places = "; ".join(f"{n.name} and {n.next} ({n.degrees:.0f} degrees)" for n in shown)
        return f"Photograph from between {places}, in steps of 10 degrees."
    if bare:
        return f"Photograph what {_some(bare)} show{'s' * (len(bare) == 1)} from more places, nearer together."
    return ""


def _new_views(measures: Measures) -> Finding | None:
    found = _psnr(measures, "test")
    if found is None:
        return None
    grade = grades.TEST_PSNR.grade(found)
    count = len([view for view in measures.views if view.split == "test"])
    text = f"Mean PSNR of {count} photograph{'s' * (count != 1)} that did not train."
    advice = "" if grade == GOOD else _why_low(measures)
    return Finding("new views", grade, f"{found:.1f} dB", text, advice)


def _why_low(measures: Measures) -> str:
    train = _psnr(measures, "train")
    if train is not None and grades.TRAIN_PSNR.grade(train) != GOOD:
        return (
            f"Training views have {train:.1f} dB only: train longer or on larger pictures (--quality, or "
            "--schedule-scale and --downscale), unless something moved or the light changed "
            "while you photographed."
        )
    return "Training views are good: more photographs of what new views show will help, more training will not."


def _training_views(measures: Measures) -> Finding | None:
    """Return the only result where nothing was held out."""
    found = _psnr(measures, "train")
    if found is None or _psnr(measures, "test") is not None:
        return None
    text = "Mean PSNR of the photographs that trained; new views are worse, nobody knows by how much."
    advice = "--test-every 8 holds every eighth photograph out and scores it."
    return Finding("training views", grades.TRAIN_PSNR.grade(found), f"{found:.1f} dB", text, advice)


def _worst_view(measures: Measures) -> Finding | None:
    rows = [(view.psnr, view.name) for view in measures.views if view.split == "test" and view.psnr is not None]
    if len(rows) < 2:
        return None
    psnr, name = min(rows)
    grade, advice = grades.WORST_PSNR.grade(psnr), ""
    if grade != GOOD:
        near = next((n for n in measures.neighbours if n.name == name), None)
        where = "" if near is None else f", {near.degrees:.0f} degrees from {near.next}"
        advice = f"Look at {name} in the report{where}: take photographs from around there."
    text = f"The worst of the photographs that did not train is {name}."
    return Finding("worst view", grade, f"{psnr:.1f} dB", text, advice, (name,))


def _gap(measures: Measures) -> Finding | None:
    train, test = _psnr(measures, "train"), _psnr(measures, "test")
    if train is None or test is None:
        return None
    grade = grades.GAP.grade(train - test)
    text = "How much better training views are than new ones."
    advice = "" if grade == GOOD else "The scene fits its photographs too closely: more photographs help most."
    return Finding("gap", grade, f"{train - test:.1f} dB", text, advice)


def _floaters(measures: Measures) -> Finding | None:
    rows = [view for view in measures.views if view.hidden is not None and view.points]
    shown = sum(view.points or 0 for view in rows)
    if not shown:
        return None
    hidden = sum(view.hidden or 0 for view in rows)
    grade = grades.HIDDEN.grade(hidden / shown)
    rate = {view.name: (view.hidden or 0) / (view.points or 1) for view in rows}
    foggy = tuple(name for name in sorted(rate, key=lambda n: -rate[n]) if grades.HIDDEN.grade(rate[name]) != GOOD)
    text = "Sparse points of new views that something nearer hides in the rendering: fog, sheets, floaters."
    advice = ""
    if grade != GOOD:
        advice = f"Worst in {_some(foggy)}: photograph from near these, and keep the light as it is."
    return Finding("floaters", grade, f"{100 * hidden / shown:.1f} % of {shown:,} points", text, advice, foggy)


def _exposure(measures: Measures) -> Finding | None:
    stops = {view.name: view.stops for view in measures.views if view.stops is not None}
    if len(stops) < 3:
        return None
    middle = median(stops.values())
    off = {name: value - middle for name, value in stops.items()}
    spread = _range_of_most(list(off.values()))
    lift = _lift(measures)
    grade = grades.EXPOSURE.grade(spread)
    views = tuple(sorted((n for n, v in off.items() if abs(v) > grades.OFF_STOPS), key=lambda n: -abs(off[n])))
    odd = f"{len(views)} differ by more than a quarter of a stop from the middle one"
    text = f"From dark to bright photographs, without the odd one in ten at either end; {odd}."
    if lift is not None and lift > 0:
        text += f" With their colours matched, new views have {lift:.1f} dB more."
    advice = ""
    if grade != GOOD and measures.learns_exposure:
        advice = "The run has learned an exposure for each photograph. Next time lock exposure and white balance."
    elif grade != GOOD:
        advice = "Train with --exposure. Next time lock exposure and white balance."
    return Finding("exposure", grade, f"{spread:.2f} stops", text, advice, views)


def _range_of_most(values: list[float]) -> float:
    """From the tenth to the ninetieth of a hundred values: one odd photograph says nothing of the others."""
    cuts = quantiles(values, n=10, method="inclusive")
    return cuts[-1] - cuts[0]


def _lift(measures: Measures) -> float | None:
    rows = [v.psnr_matched - v.psnr for v in measures.views if v.psnr_matched is not None and v.psnr is not None]
    return sum(rows) / len(rows) if rows else None


def _blur(measures: Measures) -> Finding | None:
    widths = {view.name: view.blur for view in measures.views if view.blur is not None}
    if len(widths) < 3:
        return None
    middle = median(widths.values())
    limit = max(grades.BLURRED_BY * middle, middle + grades.BLURRED_PIXELS)
    blurred = tuple(sorted((name for name, w in widths.items() if w > limit), key=lambda name: -widths[name]))
    grade = grades.BLURRED.grade(len(blurred) / len(widths))
    text = f"Edges are {middle:.1f} px wide in the middle photograph, at the size of training."
    advice = ""
    if blurred:
        text += f" In {len(blurred)} they are wider than {limit:.1f} px."
        advice = f"Leave out {_some(blurred)}, or take them again: more light, a steady hand, shorter exposures."
    return Finding("blur", grade, f"{len(blurred)} of {len(widths)} photographs", text, advice, blurred)


# -- small things ------------------------------------------------------------------------------------------------------
def _psnr(measures: Measures, split: str) -> float | None:
    rows: list[float] = [v.psnr for v in measures.views if v.split == split and v.psnr is not None]
    return sum(rows) / len(rows) if rows else None


def _some(names: Sequence[str]) -> str:
    """Return the first names in words."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


__all__ = ["Finding", "Verdict", "judge"]
