"""The verdict: grades, sentences and advice for constructed measures."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gs2d.config import grades
from gs2d.config.grades import GOOD, USABLE
from gs2d.core.json_files import write_json
from gs2d.errors import RunError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.finish.run_verdict import Finding, Measures, SurfaceSample, ViewMeasures, judge
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.verdict_section import verdict_section
from render_scenes import front_camera, splat, stack


def views(train: float = 29.0, test: float = 27.0, **changes: Any) -> tuple[ViewMeasures, ...]:
    """Twenty good training views and four good test views; the changes are of the last test view."""
    rows = [ViewMeasures(f"{i:02d}.jpg", "train", psnr=train) for i in range(20)]
    tested = [ViewMeasures(f"t{i}.jpg", "test", psnr=test, points=1000, hidden=0) for i in range(4)]
    return (*rows, *tested[:3], replace(tested[3], **changes))


def found(measures: Measures, name: str) -> Finding:
    return next(finding for finding in judge(measures).findings if finding.name == name)


# Measured on captures: mean PSNR of training views, mean and lowest PSNR of test views, sparse points in test views and
# the share of them that is hidden, placed photographs and all; and what a person calls the result.
RECORDED: dict[str, tuple[Any, ...]] = {
    "fox, draft": (35.21, 32.51, 29.94, 9317, 0.0018, (50, 50), "good"),
    "fox, a tenth of the schedule": (None, 31.00, 26.82, 0, 0.0, None, "good"),
    "fox, 2dgs without robust training": (32.7, 30.6, 27.8, 9317, 0.0085, None, "good"),
    "fountain (11), draft": (32.53, 26.33, 25.87, 9530, 0.0004, (11, 11), "good"),
    "fountain (11), normal": (36.51, 25.81, 24.96, 9530, 0.0004, (11, 11), "good"),
    "fountain (11), 2dgs without robust training": (31.2, 21.5, 19.5, 9530, 0.048, None, "usable"),
    "castle P30, draft": (31.95, 26.23, 23.58, 7874, 0.0027, (30, 30), "good"),
    "mouse, draft": (27.03, 25.64, 22.09, 6418, 0.0003, (59, 59), "good"),
    "temple, draft": (39.23, 28.37, 28.36, 1156, 0.0, (13, 16), "good"),
    "DTU scan 24, trains on all views": (31.83, None, None, 0, 0.0, None, "good"),
    "demo": (None, 31.14, 30.29, 0, 0.0, None, "good"),
    "lego": (None, 33.01, 24.99, 0, 0.0, None, "good"),
    "bottle": (None, 36.45, 33.71, 0, 0.0, None, "good"),
    "monster tree, draft": (25.53, 22.21, 21.44, 8009, 0.0041, (23, 23), "usable"),
    "bust, draft": (27.85, 22.22, 20.13, 7270, 0.0001, (56, 57), "usable"),
    "bust, 2dgs without robust training": (23.0, 19.2, 13.2, 7270, 0.373, None, "poor"),
    "castle (11), draft": (25.96, 15.70, 8.80, 4575, 0.0031, (11, 11), "poor"),
    "castle (11), normal": (29.10, 15.77, 8.73, 4576, 0.0046, (11, 11), "poor"),
    "lounge, good images of a misplaced surface": (34.79, 31.20, 27.42, 722, 0.24, (12, 12), "usable"),
    "white table, draft, points of reflections": (32.46, 31.83, 28.96, 4308, 0.098, (60, 60), "good"),
    "flat": (32.32, 24.13, 21.20, 3944, 0.030, (13, 13), "usable"),
    "lane": (20.96, 16.86, 15.27, 836, 0.097, (29, 29), "poor"),
    "kitchen": (26.26, 19.06, 15.84, 1311, 0.0023, (25, 25), "poor"),
    "museum": (24.65, 11.84, 9.81, 1248, 0.0048, (10, 10), "poor"),
}


def recorded(name: str) -> Measures:
    """Return the measures of a capture, whose test views are two with the mean and the lowest PSNR."""
    train, mean, lowest, points, share, placed, _ = RECORDED[name]
    rows = [] if train is None else [ViewMeasures("train.jpg", "train", psnr=train)]
    for i, psnr in enumerate([] if mean is None else [lowest, 2 * mean - lowest]):
        shown, hidden = (points // 2, round(share * points / 2)) if points else (None, None)
        rows.append(ViewMeasures(f"{i}.jpg", "test", psnr=psnr, points=shown, hidden=hidden))
    return Measures(tuple(rows), *(placed or ()))


@pytest.mark.parametrize("name", RECORDED)
def test_recorded_captures_get_the_grades_of_a_person(name: str) -> None:
    verdict, grade = judge(recorded(name)), RECORDED[name][-1]
    assert verdict.grade == grade
    assert any(finding.advice for finding in verdict.findings) == (grade != "good")


@pytest.mark.parametrize(
    ("psnr", "grade"), [(25.0, "good"), (24.99, "usable"), (20.0, "usable"), (19.99, "poor"), (16.7, "poor")]
)
def test_new_views_are_graded_by_their_psnr(psnr: float, grade: str) -> None:
    measures = Measures(views(train=psnr + 1, test=psnr))
    assert found(measures, "new views").grade == judge(measures).grade == grade


@pytest.mark.parametrize(
    ("change", "name", "grade", "text"),
    [
        ({"psnr": 12.5}, "new views", "usable", "t3.jpg is the worst"),
        ({"hidden": 900}, "floaters", "usable", "22.5 % of 4,000 points"),
    ],
)
def test_a_bad_view_is_reported_with_advice(change: dict[str, Any], name: str, grade: str, text: str) -> None:
    finding = found(Measures(views(**change)), name)
    assert finding.grade == grade
    assert text in f"{finding.figure} {finding.text} {finding.advice}"
    assert finding.views == ("t3.jpg",)
    assert finding.advice


def test_a_surface_that_is_unclear_in_many_pixels_is_reported_and_never_poor() -> None:
    """A veil at alpha 0.3 before a wall: the image is right, but the two depths differ."""
    wall, veil = splat((0, 0, 4), scales=(4, 4), opacity=0.99), splat((0, 0, 2), scales=(4, 4), opacity=0.3)
    settings = RasterSettings().for_depths("transmittance")
    camera = front_camera()
    clear, veiled = (
        SurfaceSample.of(camera, rasterize(scene, camera, settings, backend="cpu"))
        for scene in (wall, stack(wall, veil))
    )
    assert (clear.share(None), veiled.share(None)) == (0.0, 1.0)
    around = camera.center + np.array([[-1, -1, 3], [1, 1, 5]]) @ camera.rotation
    around = np.stack([around.min(axis=0), around.max(axis=0)])
    assert veiled.share(around) == 1.0  # the veil is before the box
    before = camera.center + np.array([[-1, -1, 0.5], [1, 1, 1]]) @ camera.rotation
    before = np.stack([before.min(axis=0), before.max(axis=0)])
    assert veiled.share(before) is None  # the wall is behind the box
    for spread, grade in ((0.14, GOOD), (0.3, USABLE), (1.0, USABLE)):
        verdict = judge(Measures(tuple(replace(view, spread=spread) for view in views())))
        assert verdict.grade == grade
        assert [f.figure for f in verdict.findings if f.name == "surface"] == (
            [] if grade == GOOD else [f"{100 * spread:.0f} % unclear"]
        )


def test_photographs_without_a_camera_are_reported_and_many_get_advice() -> None:
    few, many = (Measures(views(), placed, 24, ("lost.jpg",)) for placed in (23, 10))
    assert judge(few).grade == judge(many).grade == "good"
    assert not found(few, "placed").advice
    assert "lost.jpg" in found(few, "placed").text
    assert "lost.jpg" in found(many, "placed").advice


def test_missing_measures_are_reported_and_do_not_change_the_grade() -> None:
    measures = Measures(views(train=31.0)[:20])
    verdict = judge(measures)
    assert verdict.grade == "good"
    assert "new views were not checked" in verdict.headline
    for name in ("new views", "floaters"):
        assert (found(measures, name).grade, found(measures, name).figure) == (None, "not measured")
    assert "--test-every 8" in found(measures, "new views").text
    few, many, captured = (
        found(replace(measures, placed=count, count=count), "new views").advice for count in (11, 24, None)
    )
    assert few == "Take 30 or more photographs: with 11, new views were not checked."
    assert many == captured == ""
    assert judge(Measures(views(train=21.0)[:20])).grade == "poor"
    assert judge(Measures((), 24, 24)).grade is None


# -- in a run and its report -------------------------------------------------------------------------------------------
def test_the_report_begins_with_the_verdict(tmp_path: Path) -> None:
    path = tmp_path / "verdict.json"
    run = RunRecord(tmp_path, {})
    assert verdict_section(run) is None
    write_json(path, {"verdict": asdict(judge(Measures(views(test=18.0))))})
    html = str(verdict_section(run))
    assert '<span class="grade poor">poor</span>' in html
    assert "Take more photographs" in html
    write_json(path, {"verdict": {"grade": "good"}})
    with pytest.raises(RunError, match=r"verdict\.json was damaged"):
        verdict_section(run)


def test_a_run_has_a_verdict_of_every_view(undisturbed: RunFolder) -> None:
    data = json.loads(undisturbed.file("verdict.json").read_text())
    last = undisturbed.metrics()["stages"][-1]
    for split in ("train", "test"):
        rows = [row for row in data["measured"]["views"] if row["split"] == split]
        assert np.mean([row["psnr"] for row in rows]) == pytest.approx(last[split]["psnr"], abs=1e-6)
    assert data["verdict"]["grade"] in grades.GRADES
    assert "<summary>Verdict</summary>" in undisturbed.file("report.html").read_text()
