"""Runs with multi-view losses: results, resuming and errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ball_runs import SMALL, Stop, comparable, options
from gs2d.errors import DataError
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Step

WIDE = (  # for few cameras, far apart, and images of a few pixels
    *("multiview.max_angle=80", "multiview.max_baseline=2", "multiview.radius=1", "multiview.occluded=50"),
    *("multiview.opacity=0.05", "multiview.texture=0.001", "multiview.patches=50"),
)


def comparing(capture: Path, out: Path, **changes: Any) -> TrainOptions:
    made = options(capture, out, recipe="2dgs-multiview", overrides=(*SMALL, *WIDE))
    return replace(made, **changes)


def test_a_multi_view_run_resumes_to_the_same_bytes_and_logs_its_loss(capture: Path, tmp_path: Path) -> None:
    whole = train(comparing(capture, tmp_path / "whole"))
    logged = [line["losses"] for line in whole.events.read() if line["kind"] == "progress"]
    assert any(losses.get("multiview_photometric", 0) > 0 for losses in logged)

    def listen(event: Event) -> None:
        if isinstance(event, Step) and event.done >= 25 and "loss" in event.detail:  # views are compared from 15 on
            raise Stop

    with pytest.raises(Stop):
        train(comparing(capture, tmp_path / "run"), listen)
    resumed = train(comparing(capture, tmp_path / "run", resume=True))
    assert comparable(resumed) == comparable(whole)


def test_cameras_without_common_views_are_an_error_and_leave_nothing(capture: Path, tmp_path: Path) -> None:
    narrow = (*SMALL, "multiview.max_angle=0.1")
    with pytest.raises(DataError, match="max_angle"):
        train(comparing(capture, tmp_path / "run", overrides=narrow))
    assert not (tmp_path / "run").exists()
