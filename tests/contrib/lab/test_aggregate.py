"""Rows of a paper table where runs are missing, failed, or measured by other means than the paper's."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gs2d.cli.commands import TrainCommand
from gs2d.cli.parser import parse
from gs2d.config.protocols import MetricConventions
from gs2d.contrib.lab.aggregate import Cell, Results, check_claim, read_cell
from gs2d.contrib.lab.deviations import deviations_of
from gs2d.contrib.lab.lab_options import SweepOptions
from gs2d.contrib.lab.paper_tables import DTU, NERF_SYNTHETIC, PAPER_TABLES, TNT, Claim
from gs2d.contrib.lab.table_plan import commands_of, make_plan
from gs2d.pipeline.prepare.options import TrainOptions, values
from paper_cells import make_cell, make_row
from tiny import write_capture

# Scene a (30 dB) at both seeds, scene b (20 dB) at seed 0 only: the seeds differ by 0.2 dB, not by (30.2 - 25) dB.
UNEVEN = (make_cell("a", 0, psnr=30.0), make_cell("b", 0, psnr=20.0), make_cell("a", 1, psnr=30.2))
TWO = {"lego": 31.0, "ship": 29.0}  # dB


def test_a_seed_that_lacks_a_scene_is_no_spread_and_does_not_weigh_the_mean() -> None:
    row = make_row("row", *UNEVEN)
    results = Results((row,))
    assert results.spread(row)["psnr"] is None
    assert results.mean(row)["psnr"] == pytest.approx((30.1 + 20.0) / 2)  # not (30 + 20 + 30.2) / 3


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
    options = SweepOptions(recipes=("absgs",), data=Path("data"), out=Path("out"), slots=2)
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


def test_the_printed_commands_are_the_ones_that_were_run(tmp_path: Path) -> None:
    write_capture(tmp_path / "a b" / "bäll", train=2, test=1, size=8)
    options = SweepOptions(
        recipes=("absgs",),
        data=tmp_path / "a b",
        out=tmp_path / "o ut",
        schedule_scale=0.05,
        downscale=2,
        seeds=(3,),
        threads=1,
        overrides=("surface.densify.max_splats=7",),
    )
    jobs = make_plan(options).tasks
    assert len(jobs) == 5
    for job in jobs:
        words = shlex.split(commands_of(job)[0])
        assert words[0] == "gs2d"
        command = parse(words[1:])
        assert isinstance(command, TrainCommand)
        assert values(TrainOptions, command) == values(TrainOptions, replace(job.train, resume=False))
