"""The report: self-contained, complete, honest about what is missing; and the colours of its pictures."""

from __future__ import annotations

import base64
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

from gs2d.core.camera import Camera, look_at
from gs2d.core.json_files import write_json
from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.errors import DataError, RunError, ShapeError
from gs2d.io.meshes import write_textured
from gs2d.report import images as report_images
from gs2d.report import mesh_images as report_mesh
from gs2d.report import write as report
from gs2d.report.plots import curves, read_history, smoothed
from gs2d.report.sections import surface as report_surface
from gs2d.report.sections.surface import surface_scores
from gs2d.report.write import RunRecord, stage_table, story, verdict, write_report
from report_runs import KNOT, definition, events, fabricate, scores, stage_entry

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


def test_every_picture_decodes(page: str) -> None:
    images = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    # 4 in the head; 2 views x (1 photograph + 3 stages x 5 kinds - 1 stage without ranked splats); the second view's
    # photograph and rendering to wipe; 2 x 2 of the mesh
    assert len(images) == 4 + 2 * (1 + 15 - 1) + 2 + 4
    for data in images:
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            image.load()
            assert image.width in (48, 420)


def test_all_that_was_run_is_said(page: str) -> None:
    text = text_of(page)
    for words in ("2dgs-r", "nerf-synthetic", "still <life>", "cpu (AVX2)", "a processor & <its> makers", "torch 2.4"):
        assert words in text
    assert "40 train, 8 test" in text
    assert re.search(r"Seed\s+7", text)


def test_the_scales_of_the_pictures_say_their_ends(page: str) -> None:
    text = " ".join(text_of(page).split())
    assert "depth along the optical axis, world units 1.5 4.25" in text
    assert "mean absolute error over channels, colours in [0, 1] 0 0.2 and more" in text


def test_names_from_files_cannot_break_the_page(page: str) -> None:
    assert "still <life>" not in page
    assert "still &lt;life&gt;" in page


def test_the_same_run_gives_the_same_report(run: Path, page: str) -> None:
    assert write_report(run).read_text() == page


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


def test_the_verdict_takes_the_first_threshold_of_the_surface() -> None:
    rows = [{"threshold": t, "f_score": f} for t, f in ((0.01, 0.4), (0.02, 0.7), (0.04, 0.9))]
    assert "an F-score of 0.400 within 0.01 (units of the truth)" in verdict(record(surface={"thresholds": rows}))


def test_the_verdict_does_not_hide_a_loss_or_an_unfinished_run() -> None:
    worse = {**stage_entry(1), "test": scores(26.1)}
    text = text_of(verdict(record(stages=(stage_entry(0), worse))))
    assert "0.40 dB less than after its first stage" in text
    assert "Not finished: refine." in text


def test_a_scene_without_test_views_is_judged_on_its_training_views() -> None:
    stages = tuple({**stage_entry(k), "test": None, "test_reason": "the scene has no test views"} for k in range(3))
    told = record(stages=stages)
    assert "28.35 dB PSNR on the train views" in text_of(verdict(told)).replace("  ", " ")
    table = stage_table(told)
    assert "PSNR, dB (test)" not in table
    assert "test views: the scene has no test views" in table


def test_the_table_marks_the_best_and_says_why_lpips_is_missing() -> None:
    table = stage_table(record())
    assert '<td class="best">27.35</td>' in table
    assert table.count('class="best"') == 4  # PSNR and SSIM of both splits, once each
    assert "LPIPS (test)" not in table
    assert table.count("LPIPS: no weights: use --lpips-weights") == 1
    assert "changed PSNR on the test views from 26.90 to 26.40 dB" in table


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


def test_a_run_that_was_given_a_title_has_it_as_the_heading() -> None:
    assert report._title(record()) == "still <life>"
    titled = replace(record(), definition={**record().definition, "title": "gs2d demo"})
    assert report._title(titled) == "gs2d demo"


def test_the_story_counts_what_the_log_says() -> None:
    text = text_of(story(events()))
    assert "Started from 5,000 splats (random)." in text
    # Three densifications of 10 clones, 20 splits and 4 + 1 pruned, each followed by a reset.
    assert "surface: densification cloned 30, split 60 and pruned 15 splats; 3 opacity resets." in text
    assert "the worst 200 splats, which hold 12.3 % of the summed colour error" in text
    assert "refine: cloned 200 splats in place (opacity: copy), 20,200 after it." in text


# -- curves ------------------------------------------------------------------------------------------------------------
def test_iterations_count_over_all_stages() -> None:
    history = read_history(events())
    assert [(s.name, s.start, s.stop) for s in history.stages] == [
        ("surface", 0, 3000),
        ("appearance", 3000, 4000),
        ("refine", 4000, 6000),
    ]
    iterations, _ = history.series["splats"]
    np.testing.assert_array_equal(iterations, np.arange(20, 6001, 20))
    normal, _ = history.series["loss/normal_consistency"]
    assert not ((normal > 3000) & (normal <= 4000)).any()


def test_an_interrupted_log_and_other_names_are_understood() -> None:
    lines = [
        {"event": "progress", "stage": "only", "iteration": 10, "losses": {"l1": 0.1}, "mean_k_a": 0.5, "psnr": "n/a"},
        {"event": "progress", "stage": "only", "iteration": 20, "losses": {"l1": float("nan")}, "mean_k_a": 0.25},
        {"event": "something", "stage": None},
    ]
    history = read_history(lines)
    assert [(s.name, s.start, s.stop) for s in history.stages] == [("only", 0, 20)]
    np.testing.assert_array_equal(history.series["mean_area"][1], [0.5, 0.25])
    np.testing.assert_array_equal(history.series["loss/l1"], [[10], [0.1]])
    assert "psnr" not in history.series


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


def test_smoothing_keeps_constants_and_ends() -> None:
    np.testing.assert_allclose(smoothed(np.full(40, 3.0)), 3.0)
    # Window of 3 over 0, 3, 6, 9: (0+3)/2, (0+3+6)/3, (3+6+9)/3, (6+9)/2.
    np.testing.assert_allclose(smoothed(np.array([0.0, 3.0, 6.0, 9.0]), 3), [1.5, 3.0, 6.0, 7.5])


# -- colours -----------------------------------------------------------------------------------------------------------
def test_a_normal_is_its_direction_whatever_its_length_and_white_where_nothing_is() -> None:
    normal = np.array([[[0, 0, 2.0], [-0.3, 0, 0], [0, 0, 0], [0, 0.5, 0]]])
    image = report_images.normal_image(normal, np.array([[1.0, 1.0, 0.0, 0.5]]))
    # (n + 1) / 2; the last is half transparent: 0.5 (0.5, 1, 0.5) + 0.5.
    np.testing.assert_allclose(image[0], [[0.5, 0.5, 1], [0, 0.5, 0.5], [1, 1, 1], [0.75, 1, 0.75]], atol=1e-6)


def test_depths_go_from_light_to_dark_between_their_limits() -> None:
    depth = np.linspace(2, 4, 101)[None]
    alpha = np.ones_like(depth)
    near, far = report_images.depth_limits(depth, alpha)
    assert (near, far) == pytest.approx((2.02, 3.98))  # 1st and 99th percentile of 2, 2.02 ... 4
    image = report_images.depth_image(depth, alpha)
    scale = report_images.depth_scale(3)
    np.testing.assert_allclose(image[0, [0, 50, 100]], scale, atol=1e-5)
    brightness = image[0].mean(axis=1)
    assert brightness[0] > brightness[50] > brightness[100]
    empty = report_images.depth_image(np.zeros((1, 2)), np.zeros((1, 2)))
    np.testing.assert_array_equal(empty, 1.0)


def test_errors_are_means_over_channels_on_a_fixed_scale() -> None:
    photo = np.full((1, 4, 3), 0.5)
    color = photo.copy()
    color[0, 1] += [0.3, 0, 0]  # mean 0.1: the middle of 0 ... 0.2
    color[0, 2] += 0.5
    color[0, 3] = 7.0  # clipped to 1 before it is compared
    image = report_images.error_image(color, photo)
    scale = report_images.error_scale(3)
    np.testing.assert_allclose(image[0], scale[[0, 1, 2, 2]], atol=1e-6)
    masked = report_images.error_image(color, photo, mask=np.array([[True, False, True, True]]))
    np.testing.assert_allclose(masked[0, 1], report_images.IGNORED)


def test_high_error_splats_are_magenta_over_grey() -> None:
    color = np.full((1, 2, 3), [0.2, 0.6, 0.4])
    image = report_images.highlight_image(color, np.array([[0.0, 1.0]]))
    assert np.ptp(image[0, 0]) < 1e-6
    assert image[0, 1, 0] > 3 * image[0, 1, 1]
    assert image[0, 1, 2] > 3 * image[0, 1, 1]


def test_pictures_refuse_arrays_of_other_sizes() -> None:
    with pytest.raises(ShapeError, match="alpha must be"):
        report_images.normal_image(np.zeros((2, 3, 3)), np.zeros((3, 2)))
    with pytest.raises(ShapeError, match="color must be"):
        report_images.error_image(np.zeros((2, 2, 3)), np.zeros((2, 3, 3)))


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


def test_a_mesh_is_shaded_the_same_in_any_number_of_rows_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices = np.random.default_rng(0).uniform(-1, 1, (60, 3)) + np.array([0, 0, 3.0])
    colors = np.random.default_rng(1).integers(0, 256, (60, 3), np.uint8)
    mesh = Mesh(vertices, np.arange(60, dtype=np.int32).reshape(20, 3), colors)
    camera = Camera(40, 50, 40.0, 40.0, 20.0, 25.0, np.eye(4))
    whole = report_mesh.mesh_images(mesh, [camera], width=40)[0]
    monkeypatch.setattr(report_mesh, "_ROWS_AT_ONCE", 6)
    parts = report_mesh.mesh_images(mesh, [camera], width=40)[0]
    np.testing.assert_allclose(parts.shape, whole.shape, atol=1e-6)
    assert whole.color is not None
    assert parts.color is not None
    np.testing.assert_array_equal(parts.color, whole.color)
    assert len(np.unique(whole.color.reshape(-1, 3), axis=0)) > 500


def test_the_capture_s_cameras_show_the_mesh_where_they_are_given(tmp_path: Path) -> None:
    run = fabricate(tmp_path / "run", size=16)
    assert "taking the third axis as up" in write_report(run).read_text()
    camera = look_at(np.array([3.0, 0, 0]), np.zeros(3), np.array([0, 0, 1.0]), width=30, height=20, fx=30)
    text = text_of(write_report(run, cameras=[camera]).read_text())
    assert (
        "The mesh, 1,680 vertices, 3,360 faces, as clay and in its vertex colours" not in text
    )  # vertices repeat on seams
    assert f"The mesh, {len(KNOT.vertices):,} vertices, 3,360 faces" in text
    assert "from cameras of the capture" in text


def test_figures_of_metrics_json_are_in_the_page_word_for_word(run: Path, page: str) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    shown = text_of(page)
    assert json.dumps(metrics["surface"], indent=2).splitlines()[1].strip() in shown


def test_the_other_conventions_of_the_image_metrics_are_named_beside_the_table() -> None:
    scored = {**scores(27.35), "psnr_float": 27.361, "ssim_float": 0.91234, "lpips": 0.1, "lpips_signed": 0.15678}
    text = text_of(stage_table(record(stages=({**stage_entry(2), "test": scored},))))
    assert "From floats, unrounded, the last stage has 27.36 dB and 0.9123 (test views)." in text
    assert "fed with [-1, 1], as its authors do, it is 0.1568" in text
    assert "From floats" not in text_of(stage_table(record()))  # an older run


def test_transparent_pixels_have_a_column_and_the_worst_view_where_they_were_counted() -> None:
    counted = {**stage_entry(2), "transparent": {"part": 0.0123, "view": "b.jpg", "worst": 0.2}}
    text = text_of(stage_table(record(stages=(counted,))))
    assert "Transparent, %" in text
    assert "1.2" in text
    assert "b.jpg ( 20.0 %)" in text.replace("(20", "( 20")
    assert "ransparent" not in text_of(stage_table(record()))
