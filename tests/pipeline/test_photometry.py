"""Vignetting and response in a whole run: file, report, resuming, and later commands."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from ball_runs import SMALL, options
from gs2d.core.vignetting import reach_of
from gs2d.io.run_dir import LEARNED, REPORT, RunFolder
from gs2d.pipeline.prepare.loaded import reload_run
from gs2d.pipeline.prepare.run_appearance import as_scene, photographed
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice, ignore

EARLY = (
    *SMALL,
    *(f"learned.{name}.{value}" for name in ("vignetting", "response") for value in ("start=5", "rate=0.02")),
)


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    notices: list[str] = []

    def listen(event: Event) -> None:
        notices.extend([event.text] if isinstance(event, Notice) else [])

    folder = tmp_path_factory.mktemp("runs") / "photometry"
    made = train(options(capture, folder, learn="vignetting,response", overrides=EARLY), listen)
    assert any(text.startswith("vignetting leaves ") and text.endswith(LEARNED) for text in notices)
    return made


def test_views_have_the_vignetting_of_their_camera_and_the_report_shows_it(run: RunFolder) -> None:
    (camera,) = json.loads(run.file(LEARNED).read_text())["cameras"]
    job = reload_run(run, ignore)
    assert camera["photographs"] == [view.name for view in job.scene.views]
    for view in job.scene.views:
        falloff = view.appearance["vignetting"] * camera["reach"] ** np.array([2, 4, 6])
        assert falloff == pytest.approx(np.array(camera["falloff"]))
        assert view.appearance["response"] == 0
    assert max(map(abs, camera["falloff"])) > 0.005
    assert "Vignetting and response: " in run.file(REPORT).read_text()
    assert run.definition()["recipe"]["name"] == "2dgs-r-photometry"


def test_applying_and_removing_the_appearance_are_inverse(run: RunFolder) -> None:
    view = reload_run(run, ignore).scene.train[0]
    reach = reach_of([view.camera])
    view = view.with_appearance({"vignetting": np.array([0.4 / reach**2, 0.0, 0.0])})
    color = torch.full((view.camera.height, view.camera.width, 3), 0.5)
    seen = photographed(view, color, (0.0, 0.0, 0.0))
    alpha = torch.from_numpy(view.alpha())
    corner, middle = seen[0, 0, 0], seen[view.camera.height // 2, view.camera.width // 2, 0]
    assert float(corner) < 0.36  # 0.5 exp(-0.4) and a little
    assert float(middle) == pytest.approx(0.5, abs=0.01)
    assert alpha.shape == seen.shape[:2]
    back, given = as_scene(view), view.image()
    assert np.array_equal(back[..., 3], given[..., 3])
    assert (back[..., :3] >= given[..., :3]).all()
    assert back[0, :, :3].sum() >= given[0, :, :3].sum()
