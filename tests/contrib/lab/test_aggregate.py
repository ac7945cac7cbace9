"""Rows of a paper table where runs are missing, failed, or measured by other means than the paper's."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gs2d.cli.commands import Paper, Train
from gs2d.cli.parser import parse
from gs2d.config.protocols import MetricConventions
from gs2d.contrib.lab.aggregate import Cell, Results, check_claim, read_cell
from gs2d.contrib.lab.deviations import deviations_of, opacity_resets
from gs2d.contrib.lab.options import PaperOptions, SweepOptions, parse_seeds
from gs2d.contrib.lab.paper import check_folder, paper
from gs2d.contrib.lab.plan import commands_of, make_plan, paper_command
from gs2d.contrib.lab.scenes import find_scenes
from gs2d.contrib.lab.tables import DTU, NERF_SYNTHETIC, PAPER_TABLES, TNT, Claim
from gs2d.errors import DataError, RecipeError, RunError
from gs2d.pipeline.prepare.options import TrainOptions, values
from paper_cells import make_cell, make_row
from tiny import write_ball_mesh, write_capture

# Scene a (30 dB) at both seeds, scene b (20 dB) at seed 0 only: the seeds differ by 0.2 dB, not by (30.2 - 25) dB.
UNEVEN = (make_cell("a", 0, psnr=30.0), make_cell("b", 0, psnr=20.0), make_cell("a", 1, psnr=30.2))
TWO = {"lego": 31.0, "ship": 29.0}  # dB


def test_a_seed_that_lacks_a_scene_is_no_spread_and_does_not_weigh_the_mean() -> None:
    row = make_row("row", *UNEVEN)
    results = Results((row,))
    assert results.spread(row)["psnr"] is None
    assert results.mean(row)["psnr"] == pytest.approx((30.1 + 20.0) / 2)  # not (30 + 20 + 30.2) / 3


def test_an_order_is_judged_at_the_seeds_that_have_every_scene() -> None:
    high = [replace(c, figures={**c.figures, "psnr": (c.figures["psnr"] or 0) + 1}) for c in UNEVEN[:2]]
    worse = replace(UNEVEN[2], figures={**UNEVEN[2].figures, "psnr": 0.0})  # seed 1, without scene b
    rows = (make_row("low", *UNEVEN), make_row("high", *high, worse))
    claim = check_claim(Claim("claim", "psnr", ("low", "high")), rows, TNT)
    assert (claim.holds, claim.steps[0].seeds, claim.steps[0].difference) == ("yes", 1, 1.0)


def test_distances_in_different_units_have_no_common_mean() -> None:
    row = make_row("row", make_cell("scan24", data_set=DTU, chamfer=0.8), make_cell("lego", data_set="x", chamfer=0.01))
    results = Results((row,))
    assert results.mean(row)["chamfer"] is None
    assert results.reasons(row)["chamfer"] == (
        "measured in different ways, which have no common mean: "
        "protocol visible-surface, units of DTU; protocol visible-surface, units of lego"
    )
    assert results.mean(row, DTU)["chamfer"] == 0.8
    other = make_row("row", make_cell("fox", data_set="x", chamfer=2.0), make_cell("cup", data_set="x", chamfer=0.01))
    assert Results((other,)).mean(other, "x")["chamfer"] is None  # each capture's unit is its own


def test_training_views_are_not_averaged_with_test_views() -> None:
    """DTU is measured on training views, 35 dB; lego and ship on test views, 31 and 29: their mean is 30, not 31.67."""

    def seen(scene: str, data_set: str, views: str, **figures: float) -> Cell:
        return replace(make_cell(scene, data_set=data_set, **figures), details={"views": views})

    scan = seen("scan24", DTU, "train", psnr=35.0, bytes=6.0)
    row = make_row("row", scan, *(seen(n, NERF_SYNTHETIC, "test", psnr=v, bytes=6.0) for n, v in TWO.items()))
    results = Results((row,))
    assert results.mean(row)["psnr"] == 30.0
    assert results.scenes("psnr") == ["lego", "ship"]
    assert results.scenes("bytes") == ["scan24", "lego", "ship"]
    assert results.mean(row, DTU)["psnr"] == 35.0
    assert results.scenes("psnr", DTU) == ["scan24"]


def test_f_scores_of_different_protocols_have_no_common_mean() -> None:
    surfaces = {"Barn": "tnt", "lego": "visible-surface"}
    cells = [replace(make_cell(n, fscore=0.5), details={"surface": {"evaluator": e}}) for n, e in surfaces.items()]
    row = make_row("row", *cells)
    results = Results((row,))
    assert results.mean(row)["fscore"] is None
    assert results.scenes("fscore") == []
    assert results.reasons(row)["fscore"].endswith("no common mean: protocol tnt; protocol visible-surface")


def test_rows_that_have_no_run_in_common_say_so() -> None:
    full = make_row("full", make_cell("a", psnr=1.0), make_cell("b", psnr=2.0))
    first = make_row("first", make_cell("a", psnr=1.0), make_cell("b"))
    second = make_row("second", make_cell("a"), make_cell("b", psnr=2.0))
    results = Results((full, first, second))
    assert results.mean(full)["psnr"] is None
    assert results.reasons(full)["psnr"] == "no scene and seed that every row has"


def test_a_run_whose_surface_could_not_be_scored_keeps_its_pictures_scores(tmp_path: Path) -> None:
    place = {"name": "a", "path": ".", "format": "blender", "train": 1, "test": 1}
    definition = {"format": 2, "recipe": {"name": "2dgs"}, "scene": place, "backend": {"name": "cpu"}}
    (tmp_path / "run.json").write_text(json.dumps(definition))
    stage: dict[str, Any] = {"name": "surface", "iterations": 3, "seconds": 5.0, "splats": 7, "bytes": 9}
    stage["test"] = {"psnr": 30.0, "psnr_float": 31.0}
    (tmp_path / "metrics.json").write_text(json.dumps({"stages": [stage], "surface": None}))
    record = {"state": "failed", "reason": "the log does not fit", "trained": True}
    options: Any = {"scene": "a", "data_set": TNT, "seed": 0, "test_on": "test"}
    cell = read_cell(tmp_path, record=record, **options)
    assert (cell.figures["psnr"], cell.figures["fscore"]) == (30.0, None)
    assert cell.reasons["fscore"] == "the log does not fit"
    floats = MetricConventions(from_8bit=False, surface="chamfer")
    other = read_cell(tmp_path, record=record, conventions=floats, **options)
    assert (other.figures["psnr"], other.details["headline"]) == (31.0, "chamfer")  # what its protocol asks for
    assert check_claim(Claim("claim", "surface", ("row", "row")), (make_row("row", other),), TNT).metric == "chamfer"
    assert read_cell(tmp_path, record={**record, "trained": False}, **options).figures["psnr"] is None


def test_a_score_that_its_own_check_does_not_believe_is_a_deviation() -> None:
    check = {"ok": False, "messages": ["only 40% of the cameras agree"]}
    details = {"backend": "cpu", "surface": {"evaluator": "visible-surface", "self_check": check}}
    cell = replace(make_cell("Barn", psnr=1.0, bytes=1.0, fscore=0.1), details=details)
    options = PaperOptions(table="absgs", data=Path("data"), out=Path("out"), slots=2)
    table = PAPER_TABLES["absgs"]
    lines = deviations_of(options, (), table, Results((make_row("row", cell),)))
    assert "Barn: do not believe the surface scores of row (seed 0): only 40% of the cameras agree" in lines
    assert any("Barn: its surface is scored by this project's visible-surface protocol" in line for line in lines)
    assert any("the paper prints no thresholds of AbsGS-A" in line for line in lines)
    assert any("2 runs shared the machine" in line for line in lines)
    frame = (
        "the capture is not in the frame of Truck_COLMAP_SfM.log (as Truck of TNT_GOF): it was aligned by its cameras"
    )
    good = {**details, "surface": {"evaluator": "tnt", "self_check": {"ok": True, "messages": [frame]}}}
    truck = replace(cell, scene="Truck", details=good)
    lines = deviations_of(options, (), table, Results((make_row("a", make_cell("Truck"), truck), make_row("b", truck))))
    assert lines.count(f"Truck: {frame}") == 1
    plain = deviations_of(options, (), PAPER_TABLES["regularisation"], Results((make_row("row", cell),)))
    assert not any("E_i" in line or "AbsGS" in line for line in plain)  # one stage: nothing was left open


def test_resets_that_a_short_schedule_has_not_are_a_deviation() -> None:
    # Every 3000 iterations while splats are added, which is until half of stage 1: 3000, 6000, 9000, 12000 of 15000.
    assert (opacity_resets(1.0), opacity_resets(0.3), opacity_resets(0.1)) == (4, 1, 0)
    options = PaperOptions(table="modules", data=Path("data"), out=Path("out"), schedule_scale=0.1)
    lines = deviations_of(options, (), PAPER_TABLES["modules"], Results(()))
    assert "opacity is reset 0 times in stage 1, in the paper 4 times: the interval is not scaled" in lines
    # 100 000 sqrt(0.1) = 31 622.8
    assert "captures without points start from 31,623 random ones, not from 100,000" in lines


def test_pieces_that_captures_lack_are_deviations_and_those_without_cameras_are_named(tmp_path: Path) -> None:
    for name in ("lego", "ship"):
        write_capture(tmp_path / name, train=3, test=2, size=8)
        (tmp_path / name / "transforms_val.json").write_text('{"camera_angle_x": 1, "frames": []}')
    (tmp_path / "lego" / "test" / "r_1.png").unlink()
    (tmp_path / "ship" / "transforms_train.json").unlink()
    scenes = find_scenes(tmp_path)
    assert [scene.name for scene in scenes] == ["lego"]
    options = PaperOptions(table="modules", data=tmp_path, out=Path("out"))
    lines = deviations_of(options, scenes, PAPER_TABLES["modules"], Results(()))
    (photo,) = [line for line in lines if "r_1.png" in line]
    assert photo.startswith(f"lego: {(tmp_path / 'lego' / 'test' / 'r_1.png').resolve()} is missing (for testing): get")
    (ship,) = [line for line in lines if line.startswith("ship")]
    assert ship.startswith(f"ship is not trained: {tmp_path / 'ship' / 'transforms_train.json'} is missing (for train")
    with pytest.raises(
        DataError, match=r"no scene 'ship' in .*; there is lego; ship: .*transforms_train\.json is miss"
    ):
        find_scenes(tmp_path, ("ship",))
    with pytest.raises(
        DataError, match=r"found none; .*transforms_train\.json is missing .* get it from nerf_synthetic"
    ):
        find_scenes(tmp_path / "ship")


def test_what_the_official_scripts_do_otherwise_is_a_deviation(tmp_path: Path) -> None:
    options = PaperOptions(table="k", data=tmp_path, out=Path("out"))
    lines = deviations_of(options, (), PAPER_TABLES["k"], Results(()))
    assert any(line.startswith("the rasterizer is gs2d's own") for line in lines)
    assert not any(line.startswith("DTU") for line in lines)  # nothing of it is trained
    write_capture(tmp_path / "lego", train=3, test=2, size=8)
    scan = replace(find_scenes(tmp_path)[0], data_set=DTU)
    lines = deviations_of(options, (scan,), PAPER_TABLES["k"], Results(()))
    assert any(line.startswith("DTU: distortion has no weight") for line in lines)


def test_another_weight_of_distortion_than_the_papers_is_a_deviation(tmp_path: Path) -> None:
    write_capture(tmp_path / "ball", train=2, test=1, size=8)
    options = PaperOptions(table="regularisation", data=tmp_path, out=tmp_path / "out")
    scenes = find_scenes(tmp_path)
    line = "ball: alpha with distortion is 1000, their protocol's; the paper's 100/10 is of TnT"
    assert line in deviations_of(options, scenes, PAPER_TABLES["regularisation"], Results(()))
    assert line not in deviations_of(options, scenes, PAPER_TABLES["modules"], Results(()))


def test_the_printed_commands_are_the_ones_that_were_run(tmp_path: Path) -> None:
    write_capture(tmp_path / "a b" / "bäll", train=2, test=1, size=8)
    options = PaperOptions(
        table="absgs",
        data=tmp_path / "a b",
        out=tmp_path / "o ut",
        schedule_scale=0.05,
        downscale=2,
        seeds=(3,),
        threads=1,
        overrides=("surface.densify.max_splats=7",),
    )
    jobs = make_plan(options).jobs
    assert len(jobs) == 5
    for job in jobs:
        words = shlex.split(commands_of(job)[0])
        assert words[0] == "gs2d"
        command = parse(words[1:])
        assert isinstance(command, Train)
        assert values(TrainOptions, command) == values(TrainOptions, replace(job.train, resume=False))


@pytest.mark.parametrize("seeds", [(0,), (1,), (7,), (0, 1, 2), (4, 2)])
def test_the_command_on_the_page_has_the_seeds_that_were_run(seeds: tuple[int, ...]) -> None:
    words = shlex.split(paper_command(PaperOptions(table="k", data=Path("a b"), out=Path("out"), seeds=seeds)))
    given = words[words.index("--seeds") + 1] if "--seeds" in words else "0"
    assert parse_seeds((given,)) == seeds
    assert words[words.index("--data") + 1] == "a b"


def test_the_command_on_the_page_is_one_that_the_program_takes_whatever_it_was_to_print() -> None:
    given = parse(
        ["paper", "k", "--data", "a b", "--out", "out", "--scenes", "c", "--downscale", "2", "--quiet", "--json"]
    )
    assert isinstance(given, Paper)
    told = parse(shlex.split(paper_command(given))[1:])
    assert told == replace(given, quiet=False, json=False)


def test_rows_of_the_paper_have_nothing_of_robust_training(tmp_path: Path) -> None:
    """What `auto` makes of photographs of no data set would be called 2DGS here."""
    write_capture(tmp_path / "ball", train=2, test=1, size=8)
    shared: Any = {"data": tmp_path / "ball", "out": tmp_path / "out"}
    (row,) = {job.train.robust for job in make_plan(PaperOptions(table="freeze", **shared)).jobs}
    (own,) = {job.train.robust for job in make_plan(SweepOptions(recipes=("2dgs",), **shared)).jobs}
    assert (row, own) == ("off", "auto")


@pytest.mark.parametrize("name", ["downscale", "threads", "slots"])
def test_zero_is_not_taken_for_the_default(name: str) -> None:
    options = replace(PaperOptions(table="k", data=Path("data"), out=Path("out")), **{name: 0})
    with pytest.raises(RecipeError, match=f"--{name} must be a whole number >= 1, got 0"):
        make_plan(options)


def test_what_is_scored_is_part_of_the_job_and_a_strange_folder_is_refused(tmp_path: Path) -> None:
    write_capture(tmp_path / "ball", train=2, test=1, size=8)
    options = PaperOptions(table="modules", data=tmp_path / "ball", out=tmp_path / "out")
    assert make_plan(options).jobs[0].wanted == ()
    write_ball_mesh(tmp_path / "ball" / "mesh_gt.ply", rings=4)
    plan = make_plan(replace(options, lpips_weights=tmp_path / "vgg.pth"))
    truth, weights = (tmp_path / "ball" / "mesh_gt.ply").resolve(), (tmp_path / "vgg.pth").resolve()
    assert plan.jobs[0].wanted == (f"surface: {truth}", f"lpips: {weights}")
    (tmp_path / "out").mkdir()
    with pytest.raises(DataError, match="LPIPS weights not found"):  # before anything is trained
        paper(replace(options, lpips_weights=tmp_path / "vgg.pth"))
    (tmp_path / "out" / "about.json").write_text("{}")
    with pytest.raises(RunError, match="must be one that gs2d paper or sweep wrote, got another file"):
        check_folder(plan)
