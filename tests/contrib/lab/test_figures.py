"""The paper's figures: what a change is, one line for each run, E_i on its scale, the files of a tiny run."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gs2d.contrib.lab.figures import rank_run, write_figures
from gs2d.core.splats import Splats
from gs2d.data.image_files import read_image
from gs2d.io.run_dir import RunFolder, load_tensors
from gs2d.pipeline.prepare.loaded import reload_run
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.attribute_changes import mean_changes, take_snapshot
from gs2d.pipeline.train.train_run import train
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
    ranking = rank_run(run, reload_run(run, lambda _event: None))
    assert ranking.when == "after surface"
    end = next(c.path for c in run.checkpoints() if c.stage == "appearance")
    assert torch.equal(ranking.worst, load_tensors(end)["state"]["groups"]["high_error"])
