"""`gs2d train --init`: initial splats from a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gs2d.errors import DataError, RunError
from gs2d.io.formats.splat_formats import write_layout
from gs2d.pipeline.prepare.loaded import check_same_run, prepare_run
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.train_run import train
from tiny import write_capture
from train_toys import random_splats


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> TrainOptions:
    folder = tmp_path_factory.mktemp("init")
    write_layout(folder / "start.ply", random_splats(30), "2dgs")
    capture = write_capture(folder / "ball")
    return TrainOptions(
        scene=capture, out=folder / "run", init=folder / "start.ply", schedule_scale=0.0005, page=False, threads=1
    )


def test_a_run_starts_from_a_file_and_resumes_only_with_it(options: TrainOptions) -> None:
    told: list[object] = []
    run = train(options, told.append)
    assert any("starting from start.ply: 30 flat splats" in str(event) for event in told)
    assert len(run.definition()["init"]) == 64
    job = prepare_run(options, lambda event: None)
    check_same_run(run, job.resolved)
    other = prepare_run(replace(options, init=None), lambda event: None)
    assert other.stage_key(0) != job.stage_key(0)
    with pytest.raises(RunError, match="--init"):
        check_same_run(run, other.resolved)


def test_invalid_initial_splats_are_errors(options: TrainOptions, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="--init"):
        prepare_run(replace(options, init=tmp_path), lambda event: None)
    with pytest.raises(DataError, match=r"none.ply"):
        prepare_run(replace(options, init=tmp_path / "none.ply"), lambda event: None)
