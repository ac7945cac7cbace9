"""Views are rendered once for final scores, images and mesh; early stages render some of them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ball_runs import options
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.finish import run_mesh as surface
from gs2d.pipeline.finish.run_mesh import mesh_run
from gs2d.pipeline.train import stage_results as recorder
from gs2d.pipeline.train.train_run import train


@pytest.fixture(scope="module")
def few(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run whose early stages are scored on two training views, and which may not render for its mesh."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorder, "EARLY_VIEWS", 2)
        patch.setattr(surface, "rasterize", None)
        return train(options(capture, tmp_path_factory.mktemp("few") / "run"))


def test_early_stages_are_scored_on_some_training_views(few: RunFolder, undisturbed: RunFolder) -> None:
    stages, whole = few.metrics()["stages"], undisturbed.metrics()["stages"]
    assert [stage["train"].get("views") for stage in stages] == [2, 2, None]
    assert all("views" not in (stage["test"] or {}) for stage in stages)
    assert stages[0]["train"]["psnr"] != whole[0]["train"]["psnr"]
    assert stages[2]["train"] == whole[2]["train"]
    assert [stage["test"] for stage in stages] == [stage["test"] for stage in whole]
    assert few.file("splats.ply").read_bytes() == undisturbed.file("splats.ply").read_bytes()


def test_the_mesh_from_scored_renderings_equals_that_of_new_renderings(few: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(few.path, tmp_path / "run")
    mesh_run(tmp_path / "run")
    assert (tmp_path / "run" / "mesh.ply").read_bytes() == few.file("mesh.ply").read_bytes()
