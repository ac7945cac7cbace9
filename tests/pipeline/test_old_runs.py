"""Run folders of version 0.1, from before names changed (``fixtures/runs_0_1``): they open, score, export, resume.

Made by ``gs2d train capture --out finished --recipe 2dgs-r --exposure --refine-poses --set surface.rates.sh0=0.003
--set init_points=150 --set sh_degree=1 --set surface.densify=null --schedule-scale 0.002``, and ``interrupted`` by the
same with ``--schedule-scale 0.03`` and SIGTERM. Pictures, mesh and older checkpoints were left out.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from gs2d.cli import run
from gs2d.config.presets import get_recipe
from gs2d.config.renamed import current_names
from gs2d.config.schedule import scale_schedule
from gs2d.config.serialize import apply_overrides, from_json, to_json
from gs2d.data import load_scene
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.job import scene_digest
from gs2d.render.backends import get_backend

FIXTURES = Path(__file__).resolve().parents[1] / "fixtures" / "runs_0_1"
OPTIONS = ["--recipe", "2dgs-r", "--exposure", "--refine-poses", "--threads", "1", "--quiet", "--no-page"]
SETS = ["surface.rates.sh0=0.003", "init_points=150", "sh_degree=1", "surface.densify=null"]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """The capture and both runs, as if they had been made here: path of the capture, instruction set, last digits."""
    shutil.copytree(FIXTURES, tmp_path / "old")
    digest = scene_digest(load_scene(FIXTURES / "capture"), lambda _: None)  # cameras differ in the last digit
    for name in ("finished", "interrupted"):
        path = tmp_path / "old" / name / "run.json"
        data = json.loads(path.read_text())
        data["scene"] |= {"path": str(tmp_path / "old" / "capture"), "digest": digest}
        data["backend"] = get_backend(data["backend"]["name"]).facts()
        path.write_text(json.dumps(data))
    return tmp_path / "old"


def test_the_recipe_of_an_old_run_is_todays(runs: Path) -> None:
    raw = json.loads((runs / "finished" / "run.json").read_text())
    assert "rates" in raw["recipe"]["stages"][0]  # or this tests nothing
    recipe = from_json(raw["recipe"])
    assert recipe.stages[0].lr.sh0 == 0.003
    assert recipe.stages[0].lr.means_decay_steps == 60
    assert recipe.exposure is not None
    assert recipe.exposure.decay_steps == 60
    assert RunFolder(runs / "finished").definition()["protocol"]["near_plane_policy"] == "cull"


def test_an_old_run_is_scored_exported_rendered_and_reported(runs: Path) -> None:
    finished = str(runs / "finished")
    assert run(["info", finished]) == 0
    assert run(["evaluate", finished, "--quiet"]) == 0
    assert run(["export", finished, "--out", str(runs / "x.ply")]) == 0
    assert run(["mesh", finished, "--quiet"]) == 0
    assert run(["report", finished]) == 0
    assert (runs / "finished" / "mesh.ply").exists()


def test_an_old_interrupted_run_goes_on_from_its_checkpoint(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [word for text in SETS for word in ("--set", text)] + ["--schedule-scale", "0.03", "--resume"]
    options = [word for word in OPTIONS if word != "--quiet"]
    assert run(["train", str(runs / "capture"), "--out", str(runs / "interrupted"), *options, *words]) == 0
    assert "resuming after 0-surface-0000230" in "".join(capsys.readouterr())
    assert (runs / "interrupted" / "splats.ply").exists()


@pytest.mark.parametrize("name", ["2dgs-r", "2dgs-r-poses", "2dgs-r-exposure", "2dgs-r-depth"])
def test_names_of_today_pass_unchanged(name: str) -> None:
    data = to_json(scale_schedule(get_recipe(name), 0.5))
    assert current_names(data) == json.loads(json.dumps(data))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("depth_prior.final=0.5", "depth_prior.final_factor=0.5"),
        ("depth_prior.horizon=10", "depth_prior.decay_steps=10"),
        ("surface.rates.means_horizon=7", "surface.lr.means_decay_steps=7"),
    ],
)
def test_overrides_may_use_the_old_names(old: str, new: str) -> None:
    recipe: Any = get_recipe("2dgs-r-depth")
    assert apply_overrides(recipe, [old]) == apply_overrides(recipe, [new]) != recipe
