"""The report: one file, complete, clear about what is missing; and the colours of its images."""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gs2d.contrib.lab.surface_section import surface_section
from gs2d.core.camera import look_at
from gs2d.core.json_files import write_json
from gs2d.data.subject_box import Subject
from gs2d.errors import DataError, RunError
from gs2d.report import mesh_view as report_view
from gs2d.report.mesh_view import MeshView, mesh_view
from gs2d.report.plots import curves, read_history
from gs2d.report.report_page import write_report
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.results_section import results_section
from gs2d.report.sections.section_registry import SECTIONS
from gs2d.report.sections.settings_section import settings_section
from report_runs import KNOT, definition, events, fabricate, stage_entry

VOID = {"meta", "img", "br", "input"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fabricate(tmp_path_factory.mktemp("report") / "run")


@pytest.fixture(scope="module")
def page(run: Path) -> str:
    return write_report(run).read_text()


class Nesting(HTMLParser):
    """Checks that tags are closed in the order they were opened, and counts them."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.count: dict[str, int] = {}
        self.sources: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1
        self.sources += [value or "" for name, value in attrs if name == "src"]
        self.links += [value or "" for name, value in attrs if name == "href"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def text_of(page: str) -> str:
    return html.unescape(re.sub(r"<[^>]+>", " ", re.sub(r"<(style|script)>.*?</\\1>", "", page, flags=re.S)))


def record(**changes: Any) -> RunRecord:
    return replace(RunRecord(Path("run"), definition(), tuple(stage_entry(k) for k in range(3))), **changes)


# -- the whole page ----------------------------------------------------------------------------------------------------
def test_the_report_is_one_well_formed_file_that_loads_nothing_else(run: Path, page: str) -> None:
    parser = Nesting()
    parser.feed(page)
    assert parser.open == []
    assert parser.count["script"] == 2  # its own, and the mesh
    assert "link" not in parser.count
    assert all(source.startswith("data:image/") for source in parser.sources)
    assert parser.links == ["mesh.ply", "metrics.json", "run.json", "events.jsonl"]
    assert "url(" not in page
    assert "http" not in re.sub(r'"data:[^"]*"', "", page)
    assert (run / "report.html").stat().st_size < 8_000_000
    assert not list(run.glob(".*tmp"))


def test_every_image_decodes(page: str) -> None:
    images = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    # The pair at the top, the pair of the second view; per view 3 stages x 5 kinds less the colour of the
    # last stage, which is in the pair, and less the first stage, where nothing was ranked.
    assert len(images) == 2 + 2 + 2 * (15 - 1 - 1)
    for data in images:
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            image.load()
            assert image.width == 48


def test_the_first_screen_has_the_verdict_three_numbers_and_the_next_command(run: Path, page: str) -> None:
    first = " ".join(text_of(page[: page.index("<details")]).split())
    for words in ("still <life>", "27.4 dB PSNR on new views", "20,200 splats, 4.7 MB", "3 min training"):
        assert words in first
    assert f"Next: gs2d view {run}" in first
    assert "triangles" in first
    write_json(run / "verdict.json", {"verdict": {"grade": "good", "headline": "It worked.", "findings": []}})
    first = text_of(write_report(run).read_text().partition("<details")[0])
    (run / "verdict.json").unlink()
    assert " ".join(first.split()).endswith(f"Next: gs2d view {run}")
    assert "good" in first
    assert "It worked." in first


def test_an_unfinished_run_says_what_is_missing(tmp_path: Path) -> None:
    write_json(tmp_path / "run.json", definition())
    text = text_of(write_report(tmp_path).read_text())
    for words in (
        "Training is not finished: surface, appearance, refine missing.",
        "No stage is finished yet",
        "There is no mesh.ply",
        "renders/ holds no images",
        "events.jsonl holds no training steps",
        f"gs2d mesh {tmp_path}",
    ):
        assert words in text
    assert "Surface scores" not in text


def test_settings_are_listed_and_names_from_files_are_escaped(page: str) -> None:
    text = " ".join(text_of(page).split())
    for words in ("2dgs-r", "nerf-synthetic", "still <life>", "cpu (AVX2)", "a processor & <its> makers", "torch 2.4"):
        assert words in text
    assert "40 training, 8 test" in text
    assert "Seed 7" in text
    assert "Depth, after refine, 1.5 to 4.25 world units" in text
    assert "colours in [0, 1] 0 0.2 and more" in text
    assert "still <life>" not in page


@pytest.mark.parametrize(
    ("kind", "line"), [("object", "9 cameras look at it"), ("scene", "the whole scene: 9 cameras")]
)
def test_the_settings_describe_the_subject(kind: str, line: str, tmp_path: Path) -> None:
    box = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 2.0]])
    subject = Subject(kind, *box, box.mean(axis=0), np.array([0.0, 0.0, 1.0]), "9 cameras look at it")
    write_json(tmp_path / "subject.json", subject.to_json())
    pairs = str(settings_section(record(path=tmp_path)))
    assert f"<dt>Subject</dt><dd>{line}" in pairs
    assert "--subject-box -1 -1 0 1 1 2" in pairs


def test_a_folder_that_is_no_run_is_an_error_and_a_broken_file_loses_only_its_part(tmp_path: Path) -> None:
    with pytest.raises(RunError):
        write_report(tmp_path)
    run = fabricate(tmp_path / "run", size=16)
    (run / "renders" / "index.json").write_text("{")
    failed: list[tuple[str, Exception]] = []
    text = text_of(write_report(run, on_failure=lambda part, error: failed.append((part, error))).read_text())
    assert [part for part, _ in failed] == ["gallery", "section views"]
    assert all(isinstance(error, DataError) and "index.json" in str(error) for _, error in failed)
    assert "The section views could not be made: " in text
    (run / "run.json").write_text("{")
    with pytest.raises(DataError, match=r"run\.json"):
        write_report(run)


# -- sections ----------------------------------------------------------------------------------------------------------
def test_the_order_of_the_sections_is_that_of_the_registry(page: str) -> None:
    shown = re.findall(r'<details class="section" id="(\w+)"', page)
    assert shown == [name for name in SECTIONS if name in shown]
    assert shown[0] == "results"
    assert {"views", "training", "surface", "files", "settings"} <= set(shown)


def test_the_table_of_results_marks_the_best_and_has_no_empty_row() -> None:
    table = str(results_section(record()))
    assert '<td class="best">27.35</td>' in table
    assert table.count('class="best"') == 4  # PSNR and SSIM of both splits, once each
    assert "LPIPS" not in table


def test_transparent_pixels_are_named_if_they_are_more_than_one_percent() -> None:
    for part, is_shown in ((0.0123, True), (0.0099, False)):
        stage = {**stage_entry(2), "transparent": {"part": part, "view": "b.jpg", "worst": 0.2}}
        text = " ".join(text_of(str(results_section(record(stages=(stage,))))).split())
        assert ("in 1.2 % of the pixels of training views" in text) == is_shown
        assert ("most in b.jpg (20.0 %)" in text) == is_shown
    assert "ransparent" not in str(results_section(record()))  # not counted


def test_surface_scores_are_shown_if_there_are_any() -> None:
    row = {"threshold": 0.02, "precision": 0.91, "recall": 0.84, "f_score": 0.8736}
    surface = {"thresholds": [row], "chamfer": 0.0123, "truth_hidden": 0.4459, "novel": 3}
    table = str(surface_section(record(surface={**surface, "ground_truth": "/somewhere/else/true.ply"})))
    assert "<td>0.02</td><td>0.9100</td><td>0.8400</td><td>0.8736</td>" in table
    assert "<td>Chamfer distance</td><td>0.0123</td>" in table
    assert '<td>Truth hidden</td><td>44.6 %</td><td class="text">share of the true surface that fewer' in table
    assert "<td>True surface</td><td>true.ply</td>" in table  # no folder of this machine
    assert "<td>Novel</td><td>3</td>" in table  # a figure of a later version
    assert surface_section(record()) is None


def test_the_image_of_a_score_and_its_alignment_check_are_in_the_report(tmp_path: Path) -> None:
    (tmp_path / "surface").mkdir()
    Image.new("RGB", (960, 640), (40, 150, 80)).save(tmp_path / "surface" / "surface.png")
    surface: dict[str, Any] = {"chamfer": 0.8, "evaluator": "tnt", "files": {"picture": "surface/surface.png"}}
    check = {"ok": True, "messages": ["aligned by its cameras"]}
    sound = str(surface_section(record(path=tmp_path, surface={**surface, "self_check": check})))
    assert sound.count("data:image/jpeg") == 1
    assert "green where the other surface is close" in sound
    assert "not reliable" not in sound
    assert "aligned by its cameras" in sound
    check = {"ok": False, "messages": ["only 40% of the cameras agree"]}
    text = str(surface_section(record(path=tmp_path / "elsewhere", surface={**surface, "self_check": check})))
    assert "These scores are not reliable: only 40% of the cameras agree" in text
    assert "data:image/jpeg" not in text


# -- curves ------------------------------------------------------------------------------------------------------------


def test_there_is_a_curve_for_each_figure_with_its_stages_named() -> None:
    drawn = curves(read_history(events()), {"surface": 26.5, "refine": 27.35}, "test")
    assert list(drawn) == [
        "Loss terms, weighted",
        "PSNR, dB",
        "Splats",
        "Mean opacity",
        "Mean splat area, square world units",
    ]
    for svg in drawn.values():
        assert svg.startswith("<?xml")
        for stage in ("surface", "appearance", "refine"):
            assert f"<!-- {stage} -->" in svg  # matplotlib writes the text of its paths as comments
    assert "<!-- 27.35 -->" in drawn["PSNR, dB"]
    assert "<!-- normal_consistency -->" in drawn["Loss terms, weighted"]


# -- the mesh ----------------------------------------------------------------------------------------------------------
def unpacked(view: MeshView) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return faces, vertices and colours as the page decodes them."""
    data = gzip.decompress(base64.b64decode(view.data))
    begin = 4 + int.from_bytes(data[:4], "little")
    header = json.loads(data[4:begin])
    assert header["paint"] == "color"
    faces = np.frombuffer(data, np.uint32, 3 * header["faces"], begin).reshape(-1, 3)
    begin += faces.nbytes
    steps = np.frombuffer(data, np.uint16, 3 * header["vertices"], begin).reshape(-1, 3)
    colors = np.frombuffer(data, np.uint8, offset=begin + steps.nbytes).reshape(-1, 3)
    return faces, np.array(header["low"]) + steps / 65535 * np.array(header["size"]), colors


def test_the_mesh_of_the_page_is_that_of_the_run(run: Path) -> None:
    camera = look_at(np.array([3.0, 0, 0]), np.zeros(3), np.array([0, 0, 1.0]), width=30, height=20, fx=30)
    view = mesh_view(run, [camera])
    assert isinstance(view, MeshView)
    faces, vertices, colors = unpacked(view)
    np.testing.assert_array_equal(faces, KNOT.faces)
    np.testing.assert_allclose(vertices, KNOT.vertices, atol=1e-4)
    assert len(colors) == len(vertices)
    np.testing.assert_allclose(json.loads(view.orbit)["eye"], camera.center, atol=1e-6)


def test_a_large_mesh_is_simplified_for_the_page_and_keeps_its_colours(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report_view, "SHOWN_FACES", 1000)
    view = mesh_view(run, ())
    assert isinstance(view, MeshView)
    faces, vertices, colors = unpacked(view)
    assert view.faces == len(KNOT.faces)
    assert len(faces) == view.shown <= 1000
    assert faces.max() < len(vertices) == len(colors)
    assert colors.std() > 10
