"""`gs2d paper`: scenes found, rows averaged, claims judged, tables written, failures named, nothing done twice."""

from __future__ import annotations

import base64
import csv
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gs2d.cli import run
from gs2d.contrib.lab import jobs as jobs_module
from gs2d.contrib.lab.aggregate import FIGURES, Results, Row, check_claim, read_cell
from gs2d.contrib.lab.options import PaperOptions, parse_seeds
from gs2d.contrib.lab.paper import paper
from gs2d.contrib.lab.plan import make_plan
from gs2d.contrib.lab.render import parts_of, shown, to_csv, to_latex, to_markdown
from gs2d.contrib.lab.scenes import find_scenes, missing_scenes
from gs2d.contrib.lab.tables import DTU, PAPER_TABLES, TNT, Claim, recipe_table
from gs2d.errors import DataError, RecipeError, RunError
from paper_cells import TINY, draw_nothing, make_cell, make_row
from tiny import write_ball_mesh, write_capture


# -- scenes --------------------------------------------------------------------------------------------------------
@pytest.fixture
def captures(tmp_path: Path) -> Path:
    """lego and a ball (with its surface), one folder down."""
    for name in ("nerf_synthetic_lego", "ball"):
        write_capture(tmp_path / "unpacked" / name, train=2, test=1, size=8)
    write_ball_mesh(tmp_path / "unpacked" / "ball" / "mesh_gt.ply", rings=4)
    return tmp_path


def test_scenes_are_found_with_their_data_set_and_ground_truth(captures: Path) -> None:
    ball, lego = find_scenes(captures)
    assert (ball.name, ball.data_set, ball.protocol.name) == ("ball", "other (nerf-synthetic)", "nerf-synthetic")
    assert ball.truth == ball.path / "mesh_gt.ply"
    assert (lego.name, lego.scene, lego.data_set) == ("nerf_synthetic_lego", "lego", "NeRF-Synthetic")
    assert not lego.scored
    assert "mesh_gt.ply is missing (to score the surface)" in lego.missing[0]
    absent, count = missing_scenes((ball, lego))["NeRF-Synthetic"]
    assert (absent[:2], len(absent), count) == (["chair", "drums"], 7, 8)


def test_a_scene_is_named_by_its_folder_or_by_the_end_of_it(captures: Path) -> None:
    assert [scene.name for scene in find_scenes(captures, ["lego"])] == ["nerf_synthetic_lego"]
    assert [scene.name for scene in find_scenes(captures / "unpacked" / "ball")] == ["ball"]
    with pytest.raises(DataError, match="no scene 'chair' in .*; there is ball, nerf_synthetic_lego"):
        find_scenes(captures, ["chair"])


def test_ground_truths_may_lie_in_a_folder_of_their_own(captures: Path) -> None:
    folder = captures / "truths"
    folder.mkdir()
    write_ball_mesh(folder / "lego.ply", rings=4)
    (lego,) = find_scenes(captures, ["lego"], truths=folder)
    assert lego.truth == folder / "lego.ply"
    assert lego.missing == ()


def test_a_folder_without_captures_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="must be a capture or hold captures .*, found none"):
        find_scenes(tmp_path)


# -- plans ---------------------------------------------------------------------------------------------------------
def test_rows_share_stages_that_train_the_same(captures: Path) -> None:
    plan = make_plan(PaperOptions(table="modules", data=captures, out=captures / "out", scenes=("ball",), seeds=(0, 1)))
    by_name = {job.name: job for job in plan.jobs}
    assert list(by_name)[:4] == [
        "ball-2dgs-s0",
        "ball-2dgs-r-module-ii-s0",
        "ball-2dgs-r-module-iii-s0",
        "ball-2dgs-r-s0",
    ]
    i, ii, iv = (by_name[f"ball-{name}-s0"].stage_keys for name in ("2dgs", "2dgs-r-module-ii", "2dgs-r"))
    assert i == ii[:1]  # stage 1 is everybody's
    assert ii[:2] == iv[:2]
    assert ii[2] != iv[2]
    assert not set(i) & set(by_name["ball-2dgs-s1"].stage_keys)  # another seed is another training


def test_an_override_must_fit_a_recipe_of_the_table(captures: Path) -> None:
    options = PaperOptions(table="modules", data=captures, out=captures / "out", overrides=("refine.iterations=5",))
    jobs = make_plan(options).jobs
    assert {job.train.recipe: job.train.overrides for job in jobs}["2dgs"] == ()
    assert {job.train.recipe: job.train.overrides for job in jobs}["2dgs-r"] == ("refine.iterations=5",)
    with pytest.raises(RecipeError, match="--set paint.iterations=5 fits no recipe of the table"):
        make_plan(PaperOptions(table="k", data=captures, out=captures / "out", overrides=("paint.iterations=5",)))


def test_the_protocol_says_how_much_photographs_are_shrunk(captures: Path) -> None:
    plan = make_plan(PaperOptions(table="k", data=captures, out=captures / "out", protocol="tnt"))
    assert {job.train.downscale for job in plan.jobs} == {2}
    assert {scene.data_set for scene in plan.scenes} == {"other (tnt)"}


def test_seeds_are_a_list_or_a_count() -> None:
    assert parse_seeds(("0,1,2",)) == parse_seeds(("0", "1", "2")) == parse_seeds(("3",)) == (0, 1, 2)
    assert parse_seeds(("7,",)) == (7,)
    assert parse_seeds(("0",)) == parse_seeds(("1",)) == (0,)
    with pytest.raises(RecipeError, match="--seeds must be whole numbers"):
        parse_seeds(("one",))


# -- rows ----------------------------------------------------------------------------------------------------------
def test_means_are_over_the_runs_that_every_row_has() -> None:
    full = make_row("full", make_cell("a", psnr=30.0), make_cell("b", psnr=20.0))
    lacking = make_row("lacking", make_cell("a", psnr=31.0), make_cell("b"))
    waiting = make_row("waiting", make_cell("a"), make_cell("b"))
    results = Results((full, lacking, waiting))
    assert results.mean(full)["psnr"] == 30.0  # not 25: b would be compared with nothing
    assert results.mean(lacking)["psnr"] == 31.0
    assert results.mean(waiting)["psnr"] is None
    assert results.reasons(waiting)["psnr"] == "a, seed 0: because"


def test_the_spread_is_over_seeds_of_the_mean_over_scenes() -> None:
    cells = [make_cell(scene, seed, psnr=value) for scene, seed, value in [("a", 0, 30.0), ("b", 0, 20.0)]]
    cells += [make_cell("a", 1, psnr=31.0), make_cell("b", 1, psnr=23.0)]
    row = make_row("row", *cells)
    results = Results((row,))
    # Means 25 and 27: their standard deviation is sqrt(((25 - 26)^2 + (27 - 26)^2) / 1) = 1.41421.
    assert results.mean(row)["psnr"] == 26.0
    assert results.spread(row)["psnr"] == pytest.approx(2**0.5)
    (part,) = parts_of(recipe_table(["row"]), results)
    assert part.rows[0].figures[part.columns.index("psnr")].measured == "26.00 ± 1.41"
    assert Results((make_row("one", make_cell(psnr=1.0)),)).spread(make_row("one", make_cell(psnr=1.0)))["psnr"] is None


def test_the_figures_of_a_run_count_shared_stages_and_the_protocols_views(tmp_path: Path) -> None:
    surface = {"name": "surface", "iterations": 3, "seconds": 5.0, "splats": 7, "bytes": 9, "test": None, "train": None}
    scores = {"psnr": 30.0, "ssim": 0.9, "lpips": None, "lpips_reason": "no weights"}
    last = {"name": "refine", "iterations": 1, "seconds": 2.0, "splats": 8, "bytes": 10, "test": scores}
    stages = [{**surface, "reused_from": "a cache"}, {**last, "train": {**scores, "psnr": 40.0}}]
    place = {"name": "a", "path": ".", "format": "blender", "train": 1, "test": 1}
    definition = {"format": 2, "recipe": {"name": "2dgs"}, "scene": place, "backend": {"name": "cpu"}}
    (tmp_path / "run.json").write_text(json.dumps(definition))
    metrics = {"stages": stages, "surface": {"chamfer": 0.5, "f_score": 0.1}}
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    options: Any = {"scene": "a", "data_set": DTU, "seed": 0, "record": {"state": "done"}}
    cell = read_cell(tmp_path, test_on="test", **options)
    assert (cell.figures["psnr"], cell.figures["seconds"], cell.figures["bytes"]) == (30.0, 7.0, 10)
    assert (cell.figures["fscore"], cell.figures["chamfer"]) == (0.1, 0.5)
    assert cell.reasons == {"lpips": "no weights"}
    assert read_cell(tmp_path, test_on="train", **options).figures["psnr"] == 40.0
    failed = {**options, "record": {"state": "failed", "reason": "no photographs"}}
    assert set(read_cell(tmp_path, test_on="test", **failed).reasons.values()) == {"no photographs"}


# -- claims --------------------------------------------------------------------------------------------------------
def rows_of(metric: str = "psnr", data_set: str = TNT, **values: list[float]) -> tuple[Row, ...]:
    """A row for each name, with a value for each seed."""
    return tuple(
        make_row(name, *(make_cell("a", seed, data_set, **{metric: value}) for seed, value in enumerate(by_seed)))
        for name, by_seed in values.items()
    )


@pytest.mark.parametrize(
    ("low", "high", "holds"),
    [([1, 2], [2, 3], "yes"), ([2, 3], [1, 2], "no"), ([1, 3], [2, 2], "open")],
)
def test_an_order_holds_if_it_does_at_every_seed(low: list[float], high: list[float], holds: str) -> None:
    claim = check_claim(Claim("claim", "psnr", ("low", "high")), rows_of(low=low, high=high), TNT)
    assert claim.holds == holds
    (step,) = claim.steps
    assert step.difference == (high[0] - low[0] + high[1] - low[1]) / 2


def test_best_flat_and_at_least() -> None:
    rows = rows_of(a=[1.0], b=[3.0], c=[2.95])
    assert check_claim(Claim("best", "psnr", ("a", "c", "b"), "best"), rows, TNT).holds == "yes"
    assert check_claim(Claim("best", "psnr", ("a", "b", "c"), "best"), rows, TNT).holds == "no"
    assert check_claim(Claim("flat", "psnr", ("b", "c"), "flat", 0.1), rows, TNT).holds == "yes"
    assert check_claim(Claim("flat", "psnr", ("a", "b", "c"), "flat", 0.1), rows, TNT).holds == "no"
    assert check_claim(Claim("at least", "psnr", ("b", "c"), "at least"), rows, TNT).holds == "no"
    assert check_claim(Claim("at least", "psnr", ("c", "c"), "at least"), rows, TNT).holds == "yes"


def test_a_surface_is_better_with_a_higher_f_score_and_a_lower_chamfer_distance() -> None:
    order = Claim("surface", "surface", ("worse", "better"))
    assert check_claim(order, rows_of("fscore", TNT, worse=[0.2], better=[0.3]), TNT).holds == "yes"
    claim = check_claim(order, rows_of("chamfer", DTU, worse=[0.8], better=[0.7]), DTU)
    assert (claim.holds, claim.metric) == ("yes", "chamfer")
    assert claim.steps[0].difference == pytest.approx(0.1)


def test_what_was_not_measured_cannot_be_judged() -> None:
    rows = (make_row("low", make_cell(psnr=1.0)), make_row("high", make_cell()))
    claim = check_claim(Claim("claim", "psnr", ("low", "high")), rows, TNT)
    assert (claim.holds, claim.reason) == ("unknown", "no PSNR of high: because")


# -- files ---------------------------------------------------------------------------------------------------------
def test_tables_show_the_measured_figures_with_the_papers_in_brackets() -> None:
    table = PAPER_TABLES["modules"]
    cells = {"(I)": 24.0, "(II)": 25.0, "(III)": 25.5, "(IV)": 24.5}
    rows = tuple(
        make_row(row.name, make_cell(psnr=cells[row.name], bytes=2e6, seconds=60.0), paper=row.paper)
        for row in table.rows
    )
    results = Results(rows)
    text = to_markdown(table, results, (), ["half the schedule"], ["gs2d train"])
    assert "| (I) | - (0.33) | 24.00 (24.30) | 2.00 | 60 |" in text
    assert "| (III) | - (0.26) | **25.50** (24.89) | 2.00 | 60 |" in text
    assert "- half the schedule" in text
    lines = list(csv.DictReader(to_csv(results).splitlines()))
    assert (lines[0]["scene"], lines[0]["psnr"], lines[1]["scene"], lines[1]["paper_psnr"]) == (
        "a",
        "24.0",
        "mean",
        "24.3",
    )
    tex = to_latex(table, results)
    assert r"(III) & - & \textbf{25.50} & 2.00 & 60 \\" in tex
    assert r"\footnotesize(0.26) & \footnotesize(24.89)" in tex
    assert tex.count("{") == tex.count("}")


def test_the_papers_figures_stand_beside_what_was_trained_on_other_data() -> None:
    table = PAPER_TABLES["benchmark"]
    rows = tuple(
        Row(row.name, row.recipe, dict(row.paper), "", (make_cell(data_set="other", psnr=30.0),) if row.recipe else ())
        for row in table.rows
    )
    text, tex = to_markdown(table, Results(rows), (), (), ()), to_latex(table, Results(rows))
    titles = [line for line in text.splitlines() if line.startswith("## ")]
    papers = [f"## The paper's figures on {d}" for d in ("TnT", "NeRF-Synthetic", "DTU")]
    assert titles[:4] == ["## other", *papers]
    assert "| SVRaster | (0.40) | (23.04) | - | (0.144) |" in text
    assert text.count("| 2DGS (60k) |") == 1  # the control is not in the paper
    assert r"    SVRaster & \footnotesize(0.40) & \footnotesize(23.04) & - & \footnotesize(0.144) \\" in tex
    assert tex.count(r"\begin{tabular}{lcccc}") == 3
    # every line of a table has as many cells as its head
    for part in tex.split(r"\begin{tabular}")[1:]:
        width = part.partition("}")[0].count("c")
        lines = [line for line in part.splitlines() if line.endswith(r"\\")]
        assert lines
        assert {line.count("&") for line in lines} == {width}


def test_what_latex_would_read_as_its_own_is_escaped() -> None:
    table = replace(PAPER_TABLES["k"], title=r"50 % of #1_a & {b} < $c^2$ ~ \d")
    caption = next(line for line in to_latex(table, Results(())).splitlines() if "caption" in line)
    assert caption.startswith(
        r"  \caption{50 \% of \#1\_a \& \{b\} \textless{} \$c\textasciicircum{}2\$ "
        r"\textasciitilde{} \textbackslash{}d."
    )


def test_figures_have_the_digits_that_fit_them() -> None:
    assert [shown("chamfer", 0.00392), shown("chamfer", 0.774), shown("bytes", 5.5e6)] == ["0.00392", "0.774", "5.50"]
    assert [shown("seconds", 0.84), shown("seconds", 612.4), shown("psnr", None)] == ["0.8", "612", "-"]


# -- the command ---------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, list[str]]]:
    """The modules table of a ball, and of a capture with a broken photograph; and the command."""
    folder = tmp_path_factory.mktemp("paper")
    for name in ("ball", "broken"):
        write_capture(folder / "data" / name, train=3, test=1, size=20)
    (folder / "data" / "broken" / "train" / "r_1.png").write_bytes(b"no picture")
    words = ["paper", "modules", "--data", str(folder / "data"), "--out", str(folder / "out"), "--threads", "1", *TINY]
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        assert run([*words, "--quiet"]) == 2
        yield folder / "out", words


def test_the_table_is_a_list_of_rows_in_the_papers_order(finished: tuple[Path, list[str]]) -> None:
    rows = json.loads((finished[0] / "table.json").read_text())
    assert [row["name"] for row in rows] == ["(I)", "(II)", "(III)", "(IV)"]
    for row in rows:
        assert set(FIGURES) <= row["mean"].keys()
        assert row["mean"]["psnr"] > 0
        assert row["mean"]["bytes"] > 0
        assert row["paper"]["TnT"]["psnr"] > 24
        assert any("the schedule is 0.0005 of the paper's" in text for text in row["deviations"])
    # Stage 1 was trained once, and its seconds count in every row.
    firsts = [next(c for c in row["scenes"] if c["scene"] == "ball")["stages"][0]["seconds"] for row in rows]
    assert len(set(firsts)) == 1
    for name in ("table.md", "table.csv", "table.tex"):
        assert "(III)" in (finished[0] / name).read_text()


def test_a_broken_scene_leaves_null_with_the_reason_and_the_others_go_on(finished: tuple[Path, list[str]]) -> None:
    rows = json.loads((finished[0] / "table.json").read_text())
    cells = [cell for row in rows for cell in row["scenes"] if cell["scene"] == "broken"]
    assert len(cells) == 4
    for cell in cells:
        assert cell["psnr"] is None
        assert "r_1.png" in cell["reasons"]["psnr"]
    about = json.loads((finished[0] / "about.json").read_text())
    assert set(about["failures"]) == {
        f"broken-{name}-s0" for name in ("2dgs", "2dgs-r", "2dgs-r-module-ii", "2dgs-r-module-iii")
    }
    (line,) = [text for text in about["deviations"] if "failed" in text]
    assert line.startswith("broken: failed for (I) (seed 0), (II) (seed 0), (III) (seed 0), (IV) (seed 0): ")


def test_the_page_shows_figures_pictures_and_orders_and_needs_nothing_else(finished: tuple[Path, list[str]]) -> None:
    page = (finished[0] / "index.html").read_text()
    assert page.count("data:image/jpeg") >= 1 + 3 * 4  # a photograph, and colour, normals and error of four rows
    assert "PSNR I &lt; IV &lt; II &lt; III" in page
    assert "24.89" in page  # the paper's
    assert "<summary>Protocol nerf-synthetic</summary>" in page
    assert "r_1.png" in page
    assert "http" not in page
    labels = base64.b64encode(b"['(I)', '(II)', '(III)', '(IV)'] ['(IV)']").decode()
    assert labels in page  # every run's traces, and one map of E_i, of a recipe that ranks


def test_what_is_done_is_not_done_again(
    finished: tuple[Path, list[str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, words = finished
    tried: list[str] = []

    def train(job: jobs_module.Job, _on_event: object) -> dict[str, str]:
        tried.append(job.name)
        raise DataError("still broken")

    monkeypatch.setattr(jobs_module, "train_and_evaluate", train)
    before = (out / "runs" / "ball-2dgs-s0" / "splats.ply").stat().st_mtime_ns
    assert run([*words, "--json"]) == 2
    assert len(tried) == 4
    assert all(name.startswith("broken") for name in tried)
    assert (out / "runs" / "ball-2dgs-s0" / "splats.ply").stat().st_mtime_ns == before
    said = capsys.readouterr()
    assert json.loads(said.out)["rows"][0]["name"] == "(I)"
    assert said.err.splitlines()[-1].startswith(
        "error: 4 of the runs failed, the table is written without what they lack: broken-2dgs"
    )


@pytest.mark.slow
def test_a_command_killed_at_any_moment_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    write_capture(tmp_path / "data" / "ball", train=3, test=1, size=20)
    words = ["paper", "modules", "--data", str(tmp_path / "data"), "--threads", "1", *TINY, "--quiet", "--out"]
    killed, undisturbed = tmp_path / "killed", tmp_path / "undisturbed"
    records = killed / "jobs"
    with subprocess.Popen([sys.executable, "-m", "gs2d", *words, str(killed)]) as process:
        while process.poll() is None and not (records / "ball-2dgs-r-module-ii-s0.json").exists():
            time.sleep(0.01)
        time.sleep(0.3)  # somewhere in the second job
        process.send_signal(signal.SIGKILL)
    assert json.loads((records / "ball-2dgs-s0.json").read_text())["state"] == "done"
    assert not (records / "ball-2dgs-r-s0.json").exists()
    assert run([*words, str(killed)]) == run([*words, str(undisturbed)]) == 0
    for name in ("ball-2dgs-s0", "ball-2dgs-r-module-ii-s0", "ball-2dgs-r-module-iii-s0", "ball-2dgs-r-s0"):
        found = [(out / "runs" / name / "splats.ply").read_bytes() for out in (killed, undisturbed)]
        assert found[0] == found[1]
    tables = [json.loads((out / "table.json").read_text()) for out in (killed, undisturbed)]
    assert [row["mean"]["psnr"] for row in tables[0]] == [row["mean"]["psnr"] for row in tables[1]]


def test_a_folder_made_with_other_options_is_refused(finished: tuple[Path, list[str]]) -> None:
    out, words = finished
    options = PaperOptions(table="modules", data=Path(words[3]), out=out, schedule_scale=0.1)
    with pytest.raises(RunError, match="made with schedule_scale = 0.0005, now 0.1"):
        paper(options)


def test_quoted_rows_are_shown_where_the_paper_has_figures_of_them() -> None:
    table = PAPER_TABLES["benchmark"]
    rows = tuple(
        Row(row.name, row.recipe, dict(row.paper), "", (make_cell(data_set=DTU, psnr=30.0),) if row.recipe else ())
        for row in table.rows
    )
    text = to_markdown(table, Results(rows), (), (), ())
    assert "| NeuS | (0.84) | (31.97) | (0.840) | - | - | - |" in text
    trained = text.partition("## The paper's figures on")[0]
    assert "SVRaster" not in trained  # the paper has no figures of it on DTU
    assert "| 2DGS-R | - (0.74) | **30.00** (35.69) |" in text
    assert r"NeuS & \footnotesize(0.84) & \footnotesize(31.97)" in to_latex(table, Results(rows))
