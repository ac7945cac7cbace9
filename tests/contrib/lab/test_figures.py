"""The paper's figures: one line for each run, E_i on its scale, the files of a tiny run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gs2d.contrib.lab.figures import rank_run, write_figures
from gs2d.data.image_files import read_image
from gs2d.io.run_dir import RunFolder, load_tensors
from gs2d.pipeline.prepare.loaded import reload_run
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.train_run import train
from tiny import write_capture


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
    assert [file.name for file in files] == ["traces.svg", "errors-2DGS-R-ours-.png"]
    text = files[0].read_text()
    assert "<!-- 2DGS-R (ours) -->" in text
    assert "<!-- refine -->" in text
    image = read_image(files[1])
    assert image.shape[1] > 1000
    assert len(np.unique(image.reshape(-1, image.shape[2]), axis=0)) > 500


def test_the_ranking_is_that_of_training(runs: dict[str, Path]) -> None:
    run = RunFolder(runs["2DGS-R (ours)"])
    ranking = rank_run(run, reload_run(run, lambda _event: None))
    assert ranking.when == "after surface"
    end = next(c.path for c in run.checkpoints() if c.stage == "appearance")
    assert torch.equal(ranking.worst, load_tensors(end)["state"]["groups"]["high_error"])
