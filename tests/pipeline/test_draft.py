"""``gs2d train --quality``: the schedule and picture size that `gs2d reconstruct` takes, of known cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import gs2d.pipeline.prepare.quality as module
from ball_runs import options
from gs2d.config.presets import get_recipe
from gs2d.errors import RecipeError
from gs2d.pipeline.prepare.quality import Quality
from gs2d.pipeline.prepare.resolve import by_quality
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A draft that fits the ball: 24 iterations on pictures of about 12 px (it has 24)."""
    monkeypatch.setattr(module, "QUALITIES", {"draft": {"cpu": Quality(24, 12)}, "full": {"cpu": Quality(None, 999)}})


def test_a_draft_of_a_capture_says_what_it_is_and_how_long_it_takes(capture: Path, tmp_path: Path) -> None:
    told: list[Event] = []
    run = train(options(capture, tmp_path / "run", quality="draft", schedule_scale=None), told.append)
    scale = 24 / get_recipe("2dgs-r").iterations
    notices = [event.text for event in told if isinstance(event, Notice)]
    assert any(text.startswith("quality draft: ") and text.endswith("(--downscale 2)") for text in notices), notices
    assert any(text.startswith("training will take about ") for text in notices)
    assert any("as they are trained on (--downscale 2)" in text for text in notices)
    assert run.definition()["downscale"] == 2
    assert run.definition()["schedule_scale"] == scale
    train(options(capture, tmp_path / "run", quality="draft", schedule_scale=None, resume=True))  # is the same run


def test_a_schedule_and_a_size_that_are_given_stay(capture: Path, tmp_path: Path) -> None:
    asked = options(capture, tmp_path / "run", quality="draft", schedule_scale=None)
    assert by_quality(replace(asked, schedule_scale=0.25), lambda _: None).schedule_scale == 0.25
    assert by_quality(replace(asked, downscale=1), lambda _: None).downscale == 1
    assert by_quality(replace(asked, quality="full"), lambda _: None).schedule_scale == 1.0


def test_a_quality_that_there_is_not_leaves_nothing(capture: Path, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="--quality"):
        train(options(capture, tmp_path / "run", quality="best"))
    assert not (tmp_path / "run").exists()
