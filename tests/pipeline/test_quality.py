"""A floor under the quality of the whole way, from photographs to scores: a silent loss of 0.3 dB does not pass.

The demo with 24 photographs of 64x64. 2DGS-R at a fiftieth of the schedule (1200 iterations): seeds 0, 1 and 2 gave
25.64, 25.72 and 25.68 dB on test views and F-scores of 0.406, 0.429 and 0.423 (middle threshold) and 0.724, 0.743 and
0.748 (largest). `best` in half as many iterations: 28.91, 28.64 and 28.28 dB; 0.782, 0.773 and 0.768; 0.921, 0.919
and 0.912 (before the Mip filter 25.7 to 26.1 dB, 0.68 to 0.70).
Who makes it better raises the floors.
"""

from __future__ import annotations

import pytest

from gs2d.contrib.demo.demo_command import DemoOptions
from gs2d.contrib.demo.run_demo import demo
from gs2d.io.run_dir import RunFolder


def _demo(tmp_path_factory: pytest.TempPathFactory, recipe: str, scale: float) -> RunFolder:
    out = tmp_path_factory.mktemp("runs") / "demo"
    few = {"train_views": 24, "test_views": 6, "size": 64}
    return demo(DemoOptions(out=out, recipe=recipe, schedule_scale=scale, page=False, threads=1, **few))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return _demo(tmp_path_factory, "2dgs-r", 0.02)


@pytest.fixture(scope="module")
def best(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return _demo(tmp_path_factory, "best", 0.03)


def test_the_psnr_of_test_views(run: RunFolder) -> None:
    psnr = {stage["name"]: stage["test"]["psnr"] for stage in run.metrics()["stages"]}
    assert 25.40 <= psnr["refine"] <= 27, psnr
    assert psnr["refine"] >= psnr["surface"] + 0.1, psnr  # 0.22 to 0.26: what 2DGS-R is for


def test_the_f_score_of_the_surface(run: RunFolder) -> None:
    f_scores = [entry["f_score"] for entry in run.metrics()["surface"]["thresholds"]]
    assert f_scores[1] >= 0.38, f_scores
    assert f_scores[2] >= 0.69, f_scores


def test_the_number_of_splats(run: RunFolder) -> None:
    splats = [stage["splats"] for stage in run.metrics()["stages"]]
    assert splats[1] == splats[0]
    assert 1.005 <= splats[2] / splats[1] <= 1.02  # one percent is cloned


def test_the_default_recipe_is_better_with_half_of_the_iterations(best: RunFolder, run: RunFolder) -> None:
    (stage,) = best.metrics()["stages"]
    assert 2 * stage["iterations"] == sum(entry["iterations"] for entry in run.metrics()["stages"])
    assert 28.0 <= stage["test"]["psnr"] <= 30, stage["test"]
    f_scores = [entry["f_score"] for entry in best.metrics()["surface"]["thresholds"]]
    assert f_scores[1] >= 0.74, f_scores
    assert f_scores[2] >= 0.89, f_scores
