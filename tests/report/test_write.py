"""The report: self-contained, complete, honest about what is missing; and the colours of its pictures."""

from __future__ import annotations

import html
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gs2d.core.camera import Camera
from gs2d.core.json_files import write_json
from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.errors import DataError, RunError
from gs2d.io.meshes import write_textured
from gs2d.report import mesh_images as report_mesh
from gs2d.report.plots import curves, read_history
from gs2d.report.sections import surface as report_surface
from gs2d.report.sections.surface import surface_scores
from gs2d.report.write import RunRecord, stage_table, verdict, write_report
from report_runs import definition, events, fabricate, scores, stage_entry

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


def record(**changes: object) -> RunRecord:
    values = {
        "path": Path("run"),
        "definition": definition(),
        "stages": tuple(stage_entry(k) for k in range(3)),
        "surface": None,
        "surface_reason": None,
        "events": [],
    }
    return RunRecord(**(values | changes))  # type: ignore[arg-type]


# -- the whole page ----------------------------------------------------------------------------------------------------
def test_the_report_is_one_well_formed_file_that_needs_nothing_else(run: Path, page: str) -> None:
    parser = Nesting()
    parser.feed(page)
    assert parser.open == []
    assert parser.count["script"] == 1  # its own, inline
    assert "link" not in parser.count
    assert all(source.startswith("data:image/") for source in parser.sources)
    assert parser.links == ["mesh.ply", "metrics.json", "run.json", "events.jsonl"]  # what is there, relative
    assert "url(" not in page
    assert "http" not in re.sub(r'"data:[^"]*"', "", page)
    assert (run / "report.html").stat().st_size < 8_000_000
    assert not list(run.glob(".*tmp"))


def test_names_from_files_cannot_break_the_page(page: str) -> None:
    assert "still <life>" not in page
    assert "still &lt;life&gt;" in page


def test_an_empty_run_says_in_words_what_is_missing(tmp_path: Path) -> None:
    write_json(tmp_path / "run.json", definition())
    text = text_of(write_report(tmp_path).read_text())
    for words in (
        "No stage of 2dgs-r is finished and scored yet",
        "metrics.json has no finished stage yet",
        "The surface was not scored",
        "There is no mesh.ply",
        "renders/ holds no pictures",
        "events.jsonl is missing or empty",
    ):
        assert words in text


def test_a_lost_picture_is_named_where_it_should_be(tmp_path: Path) -> None:
    run = fabricate(tmp_path / "run", size=16)
    (run / "renders" / "appearance" / "test__r_0.normal.png").unlink()
    (run / "renders" / "photos" / "train__r_1.png").unlink()
    text = text_of(write_report(run).read_text())
    assert "not rendered for appearance" in text
    assert "no photograph in renders/photos" in text
    assert "no splats were ranked by error up to this stage" in text  # stage surface, as fabricated


def test_a_folder_that_is_no_run_is_an_error_and_broken_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(RunError):
        write_report(tmp_path)
    run = fabricate(tmp_path / "run", size=16)
    (run / "renders" / "index.json").write_text("{")
    failed: list[tuple[str, Exception]] = []
    text = text_of(write_report(run, on_failure=lambda part, error: failed.append((part, error))).read_text())
    assert [part for part, _ in failed] == ["pictures at the top", "pictures of the stages"]
    assert all(isinstance(error, DataError) and "index.json" in str(error) for _, error in failed)
    assert "The pictures of the stages could not be made: " in text
    (run / "run.json").write_text("{")
    with pytest.raises(DataError, match=r"run\.json"):
        write_report(run)


# -- sentences and tables ----------------------------------------------------------------------------------------------
def test_the_verdict_states_gain_and_price() -> None:
    # 27.35 - 26.50 = 0.85 dB; 4686400 / 4640000 = 1.010; (20 + 45) / 100 = 65 %.
    text = text_of(verdict(record()))
    assert "2dgs-r reaches  27.35 dB  PSNR on the test views (SSIM 0.9094)" in text
    assert "0.85 dB more than after its first stage (surface), for +1.0 % storage and +65 % training time." in text


def test_the_verdict_does_not_hide_a_loss_or_an_unfinished_run() -> None:
    worse = {**stage_entry(1), "test": scores(26.1)}
    text = text_of(verdict(record(stages=(stage_entry(0), worse))))
    assert "0.40 dB less than after its first stage" in text
    assert "Not finished: refine." in text


def test_surface_figures_are_shown_or_their_absence_explained() -> None:
    row = {"threshold": 0.02, "precision": 0.91, "recall": 0.84, "f_score": 0.8736}
    surface = {"thresholds": [row], "chamfer": 0.0123, "truth_hidden": 0.4459, "novel": 3}
    table = surface_scores({**surface, "ground_truth": "/somewhere/else/true.ply"}, None)
    assert "<td>0.02</td><td>0.9100</td><td>0.8400</td><td>0.8736</td>" in table
    assert "<td>Chamfer distance</td><td>0.0123</td>" in table
    assert '<td>Truth hidden</td><td>44.6 %</td><td class="text">share of the true surface that fewer' in table
    assert "<td>True surface</td><td>true.ply</td>" in table  # no folder of this machine
    assert "<td>Novel</td><td>3</td>" in table  # a later version's figure is shown, unexplained
    assert "harmonic mean" in table
    assert "The surface was not scored: no camera saw it." in surface_scores(None, "no camera saw it")


def test_the_picture_of_a_score_and_the_doubts_about_it_are_in_the_report(tmp_path: Path) -> None:
    (tmp_path / "surface").mkdir()
    Image.new("RGB", (960, 640), (40, 150, 80)).save(tmp_path / "surface" / "surface.png")
    surface: dict[str, Any] = {"chamfer": 0.8, "evaluator": "tnt", "files": {"picture": "surface/surface.png"}}
    sound = surface_scores(
        {**surface, "self_check": {"ok": True, "messages": ["aligned by its cameras"]}}, None, tmp_path
    )
    assert sound.count("data:image/jpeg") == 1
    assert "green where the other one is near" in sound
    assert "Do not believe" not in sound
    assert "aligned by its cameras" in sound
    wrong = {"ok": False, "messages": ["only 40% of the cameras agree"]}
    text = surface_scores({**surface, "self_check": wrong}, None, tmp_path / "elsewhere")
    assert "Do not believe these figures, their own check failed: only 40% of the cameras agree" in text
    assert "data:image/jpeg" not in text


def test_every_figure_of_a_surface_score_is_explained_in_the_report() -> None:
    from dataclasses import fields

    from gs2d.evaluation.surface import SurfaceScore

    valid = {field.name for field in fields(SurfaceScore)} - {
        "scores",
        "clouds",
    }  # tables and point clouds, not figures
    assert valid <= set(report_surface._MEANINGS)


def test_there_is_a_curve_for_each_figure_with_its_stages_named() -> None:
    drawn = curves(read_history(events()), {"surface": 26.5, "refine": 27.35}, "test")
    assert list(drawn) == [
        "Loss terms, weighted",
        "PSNR, dB",
        "Splats",
        "Mean opacity",
        "Mean Kₐ = s_u s_v, square world units",
    ]
    for svg in drawn.values():
        assert svg.startswith("<?xml")
        for stage in ("surface", "appearance", "refine"):
            assert f"<!-- {stage} -->" in svg  # matplotlib writes the text of its paths as comments
    assert "<!-- 27.35 -->" in drawn["PSNR, dB"]
    assert "<!-- normal_consistency -->" in drawn["Loss terms, weighted"]


# -- the mesh ----------------------------------------------------------------------------------------------------------
def test_the_mesh_is_shaded_by_its_faces_and_coloured_by_its_vertices() -> None:
    # A square across the optical axis at depth 2, seen from behind its outside: faces are two-sided.
    vertices = np.array([[-1, -1, 2.0], [1, -1, 2.0], [1, 1, 2.0], [-1, 1, 2.0]])
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.full((4, 3), 51, np.uint8))
    camera = Camera(40, 20, 20.0, 20.0, 20.0, 10.0, np.eye(4))
    shown = report_mesh.mesh_images(mesh, [camera], width=40)[0]
    assert shown.shape.shape == (20, 40, 3)
    # The normal that faces the camera is -z; its cosine with the lamp is 1 / |(0.45, 0.65, 1)| = 0.78447.
    expected = np.array([0.86, 0.86, 0.88]) * (0.22 + 0.78 * 0.784465)
    np.testing.assert_allclose(shown.shape[10, 20], expected, atol=1e-4)
    assert shown.color is not None
    np.testing.assert_allclose(shown.color[10, 20], 0.2, atol=1e-6)
    np.testing.assert_allclose(shown.shape[10, 2], 1.0)  # beside it: white


def square_with_texture() -> TexturedMesh:
    """A square across the optical axis at depth 2: red on its left, green on its right half."""
    vertices = np.array([[-1, -1, 2.0], [1, -1, 2.0], [1, 1, 2.0], [-1, 1, 2.0]], np.float32)
    texture = np.zeros((8, 8, 3), np.uint8)
    texture[:, :4, 0], texture[:, 4:, 1] = 255, 255
    uv = (vertices[:, :2] + 1) / 2
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TexturedMesh(vertices, np.tile(np.float32([0, 0, -1]), (4, 1)), faces, uv, texture)


def test_the_mesh_is_shown_with_its_texture() -> None:
    textured = square_with_texture()
    mesh = Mesh(textured.vertices, textured.faces)
    camera = Camera(40, 20, 20.0, 20.0, 20.0, 10.0, np.eye(4))
    color = report_mesh.mesh_images(mesh, [camera], textured, width=40)[0].color
    assert color is not None
    np.testing.assert_allclose(color[10, 14], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(color[10, 25], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(color[10, 2], 1.0)  # beside it: white


def test_the_report_shows_the_textured_mesh_beside_the_clay(tmp_path: Path) -> None:
    run = fabricate(tmp_path / "run", size=16)
    before = write_report(run).read_text()
    write_textured(run / "mesh.glb", square_with_texture())
    text = write_report(run).read_text()
    assert "as clay and in its vertex colours" in text_of(before)
    assert "as clay and with its texture" in text_of(text)
    assert text.count("the mesh with its texture") >= 2
    (run / "mesh.glb").write_bytes(b"not a mesh, of some length")
    assert "a .glb file as `gs2d mesh --texture` writes it was expected" in text_of(write_report(run).read_text())


def test_figures_of_metrics_json_are_in_the_page_word_for_word(run: Path, page: str) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    shown = text_of(page)
    assert json.dumps(metrics["surface"], indent=2).splitlines()[1].strip() in shown


def test_transparent_pixels_have_a_column_and_the_worst_view_where_they_were_counted() -> None:
    counted = {**stage_entry(2), "transparent": {"part": 0.0123, "view": "b.jpg", "worst": 0.2}}
    text = text_of(stage_table(record(stages=(counted,))))
    assert "Transparent, %" in text
    assert "1.2" in text
    assert "b.jpg ( 20.0 %)" in text.replace("(20", "( 20")
    assert "ransparent" not in text_of(stage_table(record()))
