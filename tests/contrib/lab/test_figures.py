"""The paper's figures: what a change is, one line for each run, E_i on its scale, the files of a tiny run."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gs2d.contrib.lab.figures import coverage, error_positions, map_limits, rank_run, write_figures
from gs2d.contrib.lab.render import coverage_rows
from gs2d.core.splats import Splats
from gs2d.data.image_files import read_image
from gs2d.errors import RunError
from gs2d.io.run_dir import RunFolder, load_tensors
from gs2d.pipeline.events import Event, Notice
from gs2d.pipeline.prepare.job import reload_job
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.changes import SAMPLE, mean_changes, take_snapshot
from gs2d.pipeline.train.train_run import train
from gs2d.report.plots import Panel, compared, read_history
from tiny import write_capture


def one_splat() -> Splats:
    """At the origin, axes along x and y, s = (1, 2), opacity 0.5, black."""
    return Splats(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.tensor([[0.0, math.log(2.0)]]),
        opacity_logits=torch.zeros(1),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 3, 3),
    )


def test_changes_are_those_worked_by_hand() -> None:
    """Sigma goes from diag(1, 4, 0) to diag(4, 16, 0): by 3 times itself. Ten iterations, extent 2."""
    before = take_snapshot(one_splat(), 100)
    after = one_splat()
    after.means[0] = torch.tensor([0.0, 0.6, 0.8])  # by 1: half the extent
    after.log_scales += math.log(2.0)
    after.opacity_logits[0] = math.log(3.0)  # opacity 0.75
    after.sh0[0, 0, 1], after.shN[0, 2, 0] = 3.0, 4.0  # norm 5
    changes = mean_changes(before, after, iterations=10, extent=2.0)
    assert changes == pytest.approx({"mean": 0.05, "covariance": 0.3, "opacity": 0.025, "sh": 0.5})


def test_a_quarter_turn_in_its_plane_changes_the_covariance_but_a_half_turn_does_not() -> None:
    """diag(1, 4) to diag(4, 1): the difference has norm sqrt(18), Sigma sqrt(17)."""
    before = take_snapshot(one_splat(), 0)
    quarter, half = one_splat(), one_splat()
    quarter.quats[0] = torch.tensor([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])
    half.quats[0] = torch.tensor([0.0, 0, 0, 1.0])
    turned = mean_changes(before, quarter, iterations=1, extent=1.0)["covariance"]
    assert turned == pytest.approx(math.sqrt(18 / 17), rel=1e-6)
    assert mean_changes(before, half, iterations=1, extent=1.0)["covariance"] == pytest.approx(0.0, abs=1e-12)


def test_of_many_splats_a_bounded_sample_is_copied_from_the_whole_range() -> None:
    splats = one_splat().rows(torch.zeros(2 * SAMPLE + 1, dtype=torch.int64))
    sample = take_snapshot(splats, 0)
    assert len(sample.splats) <= SAMPLE
    assert len(sample.splats) > 0.6 * SAMPLE
    assert int(sample.rows[-1]) >= 2 * SAMPLE - 3


def test_a_comparison_has_a_line_for_each_run_and_leaves_out_what_no_run_has() -> None:
    def log(level: float) -> list[dict[str, object]]:
        steps = [{"kind": "step", "stage": "s", "iteration": i, "mean_opacity": level} for i in (10, 20, 30)]
        return [*steps, {"kind": "changes", "stage": "s", "iteration": 40, "mean": 0.5, "sh": float("nan")}]

    histories = {"with": read_history(log(0.7)), "without": read_history(log(0.6))}
    np.testing.assert_array_equal(histories["with"].series["change/mean"], [[40], [0.5]])
    assert "change/sh" not in histories["with"].series
    svg = compared(histories, (Panel("mean_opacity", "Opacity"), Panel("mean_area", "Area")))
    assert svg is not None
    comments = re.findall(r"<!-- (.*?) -->", svg)
    assert {"Opacity", "with", "without"} <= set(comments)
    assert "Area" not in comments
    assert compared(histories, (Panel("mean_area", "Area"),)) is None


def test_coverage_is_read_after_the_first_stage_and_at_the_end(tmp_path: Path) -> None:
    steps = [("surface", 10, 0.3, 0.5), ("surface", 20, 0.2, 0.6), ("refine", 10, 0.1, 0.7), ("refine", 20, 0.4, 0.8)]
    for name, stages in {"2DGS": ("surface",), "2DGS-R": ("surface", "refine")}.items():
        run = RunFolder(tmp_path / name)
        run.path.mkdir()
        (run.path / "run.json").write_text("{}")
        for stage, iteration, area, opacity in steps:
            if stage in stages:
                step = {"stage": stage, "iteration": iteration, "mean_area": area, "mean_opacity": opacity}
                run.events.append_text(json.dumps({"kind": "step", **step}).encode() + b"\n")
    found = coverage({name: tmp_path / name for name in ("2DGS", "2DGS-R")})
    assert found == {"2DGS": (0.2, 0.6, 0.2, 0.6), "2DGS-R": (0.2, 0.6, 0.4, 0.8)}
    # with and without NC they differ in the third digit
    assert coverage_rows(found)[1] == ["2DGS-R", "2.00e-01", "0.600", "4.00e-01", "0.800"]


def test_e_i_stands_on_a_logarithmic_scale_between_its_limits() -> None:
    positions = error_positions(torch.tensor([0.0, 1.0, 10.0, 100.0, 1e6], dtype=torch.float64), (1.0, 100.0))
    np.testing.assert_allclose(positions.numpy(), [0, 0, 0.5, 1, 1], atol=1e-12)
    low, high = map_limits(torch.tensor([0.0, 2.0, 4.0, 8.0], dtype=torch.float64))
    assert low == 4.0  # the median of those above 0
    assert 7.9 < high <= 8.0
    assert map_limits(torch.zeros(3, dtype=torch.float64)) == (1.0, 10.0)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """2DGS and 2DGS-R on the ball, 30 iterations of stage 1."""
    folder = tmp_path_factory.mktemp("figures")
    capture = write_capture(folder / "ball", size=32)
    plain = TrainOptions(scene=capture, out=folder, schedule_scale=0.001, overrides=("init_points=150",), threads=1)
    paths = {"2DGS": folder / "runs" / "2dgs", "2DGS-R (ours)": folder / "runs" / "r"}
    for path, recipe in zip(paths.values(), ("2dgs", "2dgs-r"), strict=True):
        train(replace(plain, out=path, recipe=recipe, cache=folder / "cache", checkpoint_every=5))
    return paths


def test_a_run_logs_changes_of_all_attributes_but_of_those_it_freezes(runs: dict[str, Path]) -> None:
    changes = [e for e in RunFolder(runs["2DGS-R (ours)"]).events.read() if e["kind"] == "changes"]
    assert {e["stage"] for e in changes} == {"surface", "appearance", "refine"}
    assert all(e["over"] == 5 for e in changes)
    for event in changes:
        assert (event["mean"] > 0) == (event["covariance"] > 0) == (event["stage"] != "appearance")
        assert (event["opacity"] > 0) == (event["stage"] == "surface")
        assert event["sh"] > 0


def test_figures_are_drawn_and_the_map_is_of_the_run_that_ranks(runs: dict[str, Path], tmp_path: Path) -> None:
    files = write_figures(runs, tmp_path / "out", views=1)
    assert [file.name for file in files] == ["traces.svg", "changes.svg", "errors-2DGS-R-ours-.png"]
    text = files[0].read_text()
    assert "<!-- 2DGS-R (ours) -->" in text
    assert "<!-- refine -->" in text
    image = read_image(files[2])
    assert image.shape[1] > 1000
    assert len(np.unique(image.reshape(-1, image.shape[2]), axis=0)) > 500


def test_the_ranking_is_that_of_training(runs: dict[str, Path]) -> None:
    run = RunFolder(runs["2DGS-R (ours)"])
    ranking = rank_run(run, reload_job(run, lambda _event: None))
    assert ranking.when == "after surface"
    end = next(c.path for c in run.checkpoints() if c.stage == "appearance")
    assert torch.equal(ranking.worst, load_tensors(end)["state"]["groups"]["high_error"])


def test_without_its_first_checkpoint_a_run_is_ranked_by_the_cache_then_by_what_it_knows(
    runs: dict[str, Path], tmp_path: Path
) -> None:
    """As a run whose first two stages were in the cache: it has no checkpoint of the end of stage 1 of its own."""
    run = RunFolder(tmp_path / "run")
    shutil.copytree(runs["2DGS-R (ours)"], run.path)
    job = reload_job(run, lambda _event: None)
    first, second, _ = (c.path for c in run.checkpoints() if c.iteration is None)
    trained = load_tensors(second)["state"]["groups"]["high_error"]
    first.unlink()
    ranking = rank_run(run, job)
    assert ranking.when == "after surface"
    assert torch.equal(ranking.worst, trained)
    forget_the_cache(run)
    ranking = rank_run(run, job)
    assert ranking.when == "after appearance"
    assert torch.equal(ranking.worst, trained)  # not ranked again: the colours of just these splats have changed
    second.unlink()
    assert rank_run(run, job).when == "final splats"


def forget_the_cache(run: RunFolder) -> None:
    metrics = run.metrics()
    run.write_metrics({**metrics, "stages": [{**s, "reused_from": "gone.pt"} for s in metrics["stages"]]})


def test_figures_without_data_are_left_out_and_named(runs: dict[str, Path], tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(runs["2DGS-R (ours)"], run)
    kept = [line for line in (run / "events.jsonl").read_text().splitlines(True) if '"changes"' not in line]
    (run / "events.jsonl").write_text("".join(kept))
    (run / "splats.ply").unlink()
    shutil.rmtree(run / "checkpoints")
    forget_the_cache(RunFolder(run))
    notices: list[str] = []

    def listen(event: Event) -> None:
        if isinstance(event, Notice):
            notices.append(event.text)

    files = write_figures({"old": run}, tmp_path / "out", listen)
    assert [file.name for file in files] == ["traces.svg"]
    assert any("changes.svg" in text for text in notices)
    assert any("no E_i map of old" in text and "not finished" in text for text in notices)
    with pytest.raises(RunError, match="run folder"):
        write_figures({"none": tmp_path / "nothing"}, tmp_path / "out")
