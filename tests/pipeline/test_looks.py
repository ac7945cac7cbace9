"""How often a view is rendered: once for the last scores, the pictures and the mesh; some of them before."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from ball_runs import options
from gs2d.core.camera import look_at
from gs2d.core.splats import Splats
from gs2d.data.scene import View
from gs2d.evaluation.images import ImageMetrics
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.finish import run_mesh as surface
from gs2d.pipeline.finish.run_mesh import mesh_run
from gs2d.pipeline.finish.scoring import SeenView, score_views
from gs2d.pipeline.train import run_logger as recorder
from gs2d.pipeline.train.train_run import train
from gs2d.render.backends import get_backend
from gs2d.render.types import RasterSettings


def test_whoever_visits_sees_each_view_once_with_its_photograph_and_its_scores() -> None:
    splats = Splats(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 2), -1.0),
        opacity_logits=torch.zeros(1),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 0, 3),
    )
    camera = look_at(np.array([0.0, 0.0, -3.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]), width=12, height=12, fx=14.0)
    mask = np.arange(12)[:, None].repeat(12, axis=1) < 6
    image = np.full((12, 12, 3), 51, np.uint8)
    views = [View.from_arrays("a", camera, image), View.from_arrays("b", camera, image, mask=mask)]
    visits: list[tuple[SeenView, ImageMetrics]] = []
    scores = score_views(
        *(splats, views, RasterSettings(sh_degree=0), get_backend("reference")),
        name="",
        on_event=lambda event: None,
        split="test",
        visitors=[lambda seen, metrics: visits.append((seen, metrics))],
    )
    assert [(seen.view.name, seen.split) for seen, _ in visits] == [("a", "test"), ("b", "test")]
    assert [metrics for _, metrics in visits] == [scores["a"], scores["b"]]
    for seen, _ in visits:
        assert torch.equal(seen.image, seen.output.color)
        assert float(seen.target.unique()) == pytest.approx(0.2)
        assert float(seen.output.depth_median.max()) == pytest.approx(3.0, abs=0.1)
    assert visits[0][0].mask is None
    assert torch.equal(visits[1][0].mask, torch.from_numpy(mask))


@pytest.fixture(scope="module")
def few(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run whose early stages are scored on two training views, and which may not render for its mesh."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorder, "EARLY_VIEWS", 2)
        patch.setattr(surface, "rasterize", None)
        return train(options(capture, tmp_path_factory.mktemp("few") / "run"))


def test_stages_before_the_last_are_scored_on_some_training_views_and_say_so(
    few: RunFolder, undisturbed: RunFolder
) -> None:
    stages, whole = few.metrics()["stages"], undisturbed.metrics()["stages"]
    assert [stage["train"].get("views") for stage in stages] == [2, 2, None]
    assert stages[2]["after_clone"]["train"]["views"] == 2
    assert all("views" not in (stage["test"] or {}) for stage in stages)
    assert stages[0]["train"]["psnr"] != whole[0]["train"]["psnr"]
    assert stages[2]["train"] == whole[2]["train"]
    assert [stage["test"] for stage in stages] == [stage["test"] for stage in whole]
    assert few.file("splats.ply").read_bytes() == undisturbed.file("splats.ply").read_bytes()


def test_the_mesh_of_what_was_rendered_for_the_scores_is_that_of_rendering_again(
    few: RunFolder, tmp_path: Path
) -> None:
    shutil.copytree(few.path, tmp_path / "run")
    mesh_run(tmp_path / "run")
    assert (tmp_path / "run" / "mesh.ply").read_bytes() == few.file("mesh.ply").read_bytes()
