"""``--quality`` sets training length and image size, with the same defaults in `gs2d train` and `gs2d reconstruct`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

import gs2d.pipeline.prepare.open_capture as module
from ball_runs import options
from capture_writers import small_colmap
from gs2d.config.presets import get_recipe
from gs2d.errors import RecipeError
from gs2d.pipeline.prepare.open_capture import FEW, OpenCapture, QualityLevel, open_capture
from gs2d.pipeline.prepare.options import ReconstructOptions, TrainOptions
from gs2d.pipeline.prepare.resolve import schedule_scale_of
from gs2d.pipeline.reconstruct import CAPTURE, capture_title, train_options
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice, ignore


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A draft for small images: 24 iterations at about 12 px."""
    level = {"cpu": QualityLevel(24, 12)}
    monkeypatch.setattr(
        module, "QUALITIES", {"draft": level, "normal": level, "full": {"cpu": QualityLevel(None, 999)}}
    )


def test_a_draft_is_short_and_shrunk_and_its_time_is_estimated(capture: Path, tmp_path: Path) -> None:
    heard: list[Event] = []
    run = train(options(capture, tmp_path / "run", quality="draft", schedule_scale=None), heard.append)
    notices = [event.text for event in heard if isinstance(event, Notice)]
    assert any("(--downscale 2) for 24 iterations" in text for text in notices), notices
    assert any(text.startswith("the run will take about ") for text in notices)
    assert run.definition()["downscale"] == 2
    assert run.definition()["schedule_scale"] == 24 / get_recipe("2dgs-r").iterations
    train(options(capture, tmp_path / "run", quality="draft", schedule_scale=None, resume=True))  # is the same run


def test_options_override_the_quality(capture: Path, tmp_path: Path) -> None:
    draft = options(capture, tmp_path / "run", quality="draft", schedule_scale=None)

    def scale_and_downscale(chosen: TrainOptions) -> tuple[float, int]:
        opened: OpenCapture = open_capture(chosen, ignore)
        return schedule_scale_of(chosen, opened), opened.downscale

    assert scale_and_downscale(replace(draft, schedule_scale=0.25)) == (0.25, 2)
    assert scale_and_downscale(replace(draft, downscale=1))[1] == 1
    assert scale_and_downscale(replace(draft, quality="full")) == (1.0, 1)
    assert scale_and_downscale(replace(draft, quality="auto")) == (1.0, 1)  # Blender: a known data set


def test_train_and_reconstruct_have_the_same_defaults_for_a_capture(tmp_path: Path) -> None:
    capture = tmp_path / "run" / CAPTURE
    small_colmap(capture)
    ours = train_options(ReconstructOptions(photos=tmp_path / "photos", out=tmp_path / "run"))
    theirs = TrainOptions(scene=capture, out=tmp_path / "other")
    for placed, test in ((FEW - 1, 0), (FEW, 2)):
        (capture / "poses.json").write_text(json.dumps({"photographs": [], "placed": placed, "count": placed}))
        for chosen in (ours, theirs):
            opened = open_capture(chosen, ignore)
            assert (opened.quality, len(opened.scene.test)) == (QualityLevel(24, 12), test)


def test_an_unknown_quality_is_an_error_and_leaves_nothing(capture: Path, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="--quality"):
        train(options(capture, tmp_path / "run", quality="best"))
    assert not (tmp_path / "run").exists()


def test_the_title_is_the_name_of_the_capture_and_not_of_its_folder_of_photographs() -> None:
    titles = {"a/skull": "skull", "a/skull/images": "skull", "a/skull/images_4": "skull", "a/walk.mp4": "walk"}
    assert {path: capture_title(Path(path)) for path in titles} == titles
