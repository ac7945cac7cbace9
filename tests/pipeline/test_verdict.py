"""The verdict: hand-made measures give the grades, sentences and advice that they should."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gs2d.cli.verdict import WIDTH, verdict_lines
from gs2d.config import grades
from gs2d.core.camera import look_at
from gs2d.core.json_files import write_json
from gs2d.data import View
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.verdict.judge import Finding, judge
from gs2d.pipeline.verdict.measures import (
    Measures,
    Neighbour,
    ViewMeasures,
    blur_of,
    measures_from_json,
    neighbours_of,
    placed_images,
)
from gs2d.report.sections.verdict import grade_of, verdict_section


def views(train: float = 29.0, test: float = 27.0, **changes: float) -> tuple[ViewMeasures, ...]:
    """Twenty good training views and four good test views; the changes are of the last test view."""
    good = {"stops": 0.0, "blur": 0.8, "points": 1000}
    rows = [ViewMeasures(f"{i:02d}.jpg", "train", psnr=train, **good) for i in range(20)]
    new = {"psnr": test, "psnr_matched": test, "hidden": 0, **good}
    tested = [ViewMeasures(f"t{i}.jpg", "test", **new) for i in range(3)]
    return (*rows, *tested, ViewMeasures("t3.jpg", "test", **{**new, **changes}))


def dimmed(stops: float) -> tuple[ViewMeasures, ...]:
    """The same, a quarter of the photographs darker by so many stops."""
    return tuple(replace(view, stops=-stops) if i % 4 == 0 else view for i, view in enumerate(views()))


def found(measures: Measures, name: str) -> Finding:
    return next(finding for finding in judge(measures).findings if finding.name == name)


def test_a_good_run_is_good_and_asks_for_nothing() -> None:
    near = tuple(Neighbour(f"{i:02d}.jpg", "01.jpg", 8.0) for i in range(20))
    verdict = judge(Measures(views(), near, 350.0, placed=24, count=24))
    assert verdict.grade == "good"
    assert {f.grade for f in verdict.findings} == {"good", None}  # what is around is not graded
    assert [f.advice for f in verdict.findings] == [""] * len(verdict.findings)


@pytest.mark.parametrize(
    ("psnr", "grade"), [(25.0, "good"), (24.99, "usable"), (20.0, "usable"), (19.99, "poor"), (16.7, "poor")]
)
def test_new_views_are_graded_by_their_psnr(psnr: float, grade: str) -> None:
    measures = Measures(views(train=psnr + 1, test=psnr))
    assert found(measures, "new views").grade == grade
    assert grade_of(psnr, "test") == grade


@pytest.mark.parametrize(("stops", "grade"), [(0.2, "good"), (0.5, "usable"), (1.0, "poor")])
def test_exposures_are_graded_by_the_range_of_most_photographs(stops: float, grade: str) -> None:
    finding = found(Measures(dimmed(stops)), "exposure")
    assert (finding.grade, finding.figure) == (grade, f"{stops:.2f} stops")
    assert ("--exposure" in finding.advice) == (grade != "good")


def test_one_odd_exposure_is_named_and_says_nothing_of_the_others() -> None:
    finding = found(Measures(views(stops=2.0)), "exposure")
    assert (finding.grade, finding.figure, finding.views) == ("good", "0.00 stops", ("t3.jpg",))
    assert "1 differ by more than a quarter of a stop" in finding.text


@pytest.mark.parametrize(
    ("change", "name", "grade", "said"),
    [
        ({"psnr": 12.5}, "worst view", "poor", "t3.jpg"),
        ({"psnr": 18.0}, "worst view", "usable", "t3.jpg"),
        ({"hidden": 900}, "floaters", "poor", "22.5 % of 4,000 points"),
        ({"hidden": 80}, "floaters", "usable", "2.0 % of 4,000 points"),
        ({"blur": 2.0}, "blur", "good", "t3.jpg"),
        ({"points": 50, "hidden": 0}, "overlap", "good", "t3.jpg"),
    ],
)
def test_a_single_bad_view_is_found_and_named(change: dict[str, float], name: str, grade: str, said: str) -> None:
    finding = found(Measures(views(**change)), name)
    assert finding.grade == grade
    assert said in f"{finding.figure} {finding.text} {finding.advice}"
    assert finding.views == ("t3.jpg",)
    assert finding.advice


def test_the_grade_is_the_worst_of_the_result_and_photographs_alone_make_it_usable_at_worst() -> None:
    assert judge(Measures(views(psnr=12.5))).grade == "poor"
    assert judge(Measures(views(), placed=10, count=24, lost=("x.jpg",))).grade == "usable"
    assert judge(Measures(dimmed(1.5))).grade == "usable"
    assert judge(Measures(())).grade is None


def test_without_a_new_view_nothing_is_good_and_that_is_said() -> None:
    verdict = judge(Measures(views(train=31.0)[:20]))
    assert verdict.grade == "usable"
    assert "No new view was checked" in verdict.headline
    assert "--test-every 8" in verdict.findings[-3].advice
    assert judge(Measures(views(train=21.0)[:20])).grade == "poor"


def test_a_wide_gap_between_cameras_says_where_to_photograph() -> None:
    apart = (*(Neighbour(f"{i:02d}.jpg", "01.jpg", 9.0) for i in range(19)), Neighbour("t0.jpg", "07.jpg", 31.0))
    finding = found(Measures(views(), apart, 120.0), "overlap")
    assert finding.views == ("t0.jpg",)
    assert finding.advice == "Photograph from between t0.jpg and 07.jpg (31 degrees), in steps of 10 degrees."
    assert "120 of 360 degrees" in found(Measures(views(), apart, 120.0), "coverage").figure


def test_every_limit_has_its_reason_and_its_order() -> None:
    limits = [value for value in vars(grades).values() if isinstance(value, grades.Limits)]
    assert len(limits) == 9
    for limit in limits:
        assert limit.why
        assert [limit.grade(value) for value in (limit.good, limit.usable)] == ["good", "usable"]
        beyond = limit.usable + (limit.usable - limit.good)
        assert limit.grade(beyond) == "poor"


@pytest.mark.parametrize("width", [WIDTH, 40])
def test_the_verdict_fits_the_terminal_in_words(width: int) -> None:
    near = tuple(Neighbour(f"a_long_name_of_a_photograph_{i}.jpg", "01.jpg", 40.0) for i in range(9))
    measures = Measures(views(psnr=12.5, hidden=500, stops=1.5, blur=3.0), near, 90.0, 20, 24, ("lost.jpg",))
    lines = verdict_lines(judge(measures).to_json(), width)
    assert max(map(len, lines)) <= width
    assert lines[0].startswith("Verdict: POOR.")
    assert "What to do next:" in lines


def test_measures_are_the_same_after_their_file() -> None:
    measures = Measures(views(), (Neighbour("a", "b", 3.0),), 10.0, 1, 2, ("c",), learns_exposure=True)
    assert measures_from_json(json.loads(json.dumps(measures.to_json()))) == measures
    with pytest.raises(RunError, match="expected measures"):
        measures_from_json({"views": 3})


# -- measures ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("sigma", [1.2, 1.5, 3.0])
@pytest.mark.parametrize("direction", ["both", "rows"])
def test_the_blur_of_a_step_is_its_width_whatever_its_height(sigma: float, direction: str) -> None:
    x = torch.arange(-30, 30) + 0.5
    edge = torch.special.erf(x / (sigma * 2**0.5))
    across = edge if direction == "both" else torch.sign(x)
    image = (0.5 + 0.1 * edge[:, None] + 0.1 * across[None, :])[..., None].expand(-1, -1, 3)
    assert blur_of(image) == pytest.approx(sigma, rel=0.12)
    assert blur_of(0.3 * image) == pytest.approx(blur_of(image) or 0.0, rel=1e-4)


def test_a_picture_without_edges_or_pixels_has_no_blur() -> None:
    assert blur_of(torch.full((20, 20, 3), 0.5)) is None
    assert blur_of(torch.rand(20, 20, 3), torch.zeros(20, 20, dtype=torch.bool)) is None
    assert blur_of(torch.rand(2, 2, 3)) is None


def ring(degrees: list[float], *, inwards: bool = True) -> list[View]:
    made = []
    for i, angle in enumerate(np.radians(degrees)):
        eye = np.array([4 * np.cos(angle), 4 * np.sin(angle), 0.5])
        target = np.zeros(3) if inwards else 2 * eye
        camera = look_at(eye, target, np.array([0, 0, 1.0]), width=8, height=8, fx=8.0)
        made.append(View.from_arrays(f"{i}", camera, np.zeros((8, 8, 3), np.uint8)))
    return made


def test_the_next_camera_is_the_one_nearest_in_direction_and_a_test_view_is_nobodys() -> None:
    train, test = ring([0, 10, 25, 90]), ring([30])
    test = [View.from_arrays("new", test[0].camera, np.zeros((8, 8, 3), np.uint8))]
    found, around = neighbours_of(train, test, np.array([0, 0, 0.5]))
    assert [(n.name, n.next) for n in found] == [("0", "1"), ("1", "0"), ("2", "1"), ("3", "2"), ("new", "2")]
    np.testing.assert_allclose([n.degrees for n in found], [10, 10, 15, 65, 5], atol=1e-6)
    assert around == pytest.approx(90.0)


def test_cameras_that_look_outwards_have_no_subject_around_which_to_be_near() -> None:
    assert neighbours_of(ring([0, 90, 180, 270], inwards=False), [], np.zeros(3)) == ((), None)
    assert neighbours_of(ring([0]), []) == ((), None)


def test_placed_photographs_are_those_of_the_capture(tmp_path: Path) -> None:
    assert placed_images(None) == placed_images(tmp_path) == (None, None, ())
    rows = [{"source": "a.jpg", "placed": True}, {"source": "b.jpg", "placed": False}]
    write_json(tmp_path / "poses.json", {"placed": 1, "count": 2, "photographs": rows})
    assert placed_images(tmp_path) == (1, 2, ("b.jpg",))
    write_json(tmp_path / "poses.json", {"frames": []})  # another program's
    assert placed_images(tmp_path) == (None, None, ())


# -- in a run and its report -------------------------------------------------------------------------------------------
def test_the_report_begins_with_the_verdict(tmp_path: Path) -> None:
    path = tmp_path / "verdict.json"
    assert verdict_section(path) == ""
    write_json(path, {"verdict": judge(Measures(views(psnr=12.5))).to_json()})
    html = verdict_section(path)
    assert '<span class="grade poor">poor</span>' in html
    assert "What to do or to photograph next" in html
    write_json(path, {"verdict": {"grade": "good"}})
    with pytest.raises(DataError, match=r"verdict\.json must hold a verdict"):
        verdict_section(path)


def test_a_run_has_a_verdict_of_every_view(undisturbed: RunFolder) -> None:
    data = json.loads(undisturbed.file("verdict.json").read_text())
    last = undisturbed.metrics()["stages"][-1]
    for split in ("train", "test"):
        rows = [row for row in data["measured"]["views"] if row["split"] == split]
        assert np.mean([row["psnr"] for row in rows]) == pytest.approx(last[split]["psnr"], abs=1e-6)
        assert all(row["blur"] > 0 for row in rows)
    assert data["verdict"]["grade"] in grades.GRADES
    assert "<h2>Verdict</h2>" in undisturbed.file("report.html").read_text()
