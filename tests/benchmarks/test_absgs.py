"""The sweep that chooses AbsGS-A's thresholds."""

from __future__ import annotations

from pathlib import Path

from benchmarks.absgs import CANDIDATES, Candidate, choose, make_jobs, markdown

from gs2d.config.presets import ABSGS_ADJUSTED, ABSGS_DEFAULT, get_recipe
from gs2d.config.serialize import apply_overrides
from gs2d.experiments.aggregate import FIGURES, Cell
from gs2d.experiments.options import PaperOptions
from gs2d.experiments.scenes import find_scenes
from tiny import write_capture


def cell(psnr: float | None) -> Cell:
    figures = {**dict.fromkeys(FIGURES), "psnr": psnr}
    return Cell("a", "x", 0, figures, {} if psnr else {"psnr": "diverged"}, Path("run"), {"splats": 1000})


def test_candidates_divide_the_thresholds_of_absgs() -> None:
    recipe = apply_overrides(get_recipe("2dgs-r-absgs-d"), Candidate(2, 4).overrides)
    densify = recipe.stages[-1].densify
    assert densify is not None
    # D: 2e-4 signed, 4e-4 absolute, 0.001 of the extent.
    assert (densify.grad_threshold, densify.abs_threshold, densify.percent_dense) == (1e-4, 2e-4, 0.00025)
    assert Candidate(1, 1).thresholds == {
        "grad_threshold": ABSGS_DEFAULT.grad_threshold,
        "abs_threshold": ABSGS_DEFAULT.abs_threshold,
        "percent_dense": ABSGS_DEFAULT.percent_dense,
    }


def test_the_thresholds_of_the_named_recipe_are_among_the_candidates() -> None:
    named = {name: getattr(ABSGS_ADJUSTED, name) for name in Candidate(1, 1).thresholds}
    assert named in [candidate.thresholds for candidate in CANDIDATES]


def test_candidates_share_all_but_the_last_stage(tmp_path: Path) -> None:
    write_capture(tmp_path / "ball", train=2, test=1, size=8)
    options = PaperOptions(table="absgs", data=tmp_path, out=tmp_path / "out", schedule_scale=0.01)
    jobs = make_jobs(options, find_scenes(tmp_path))
    assert len({job.name for job in jobs.values()}) == len({job.train.out for job in jobs.values()}) == 9
    keys = [job.stage_keys for job in jobs.values()]
    assert len({key[:2] for key in keys}) == 1
    assert len({key[2] for key in keys}) == 9


def test_the_best_psnr_of_whole_candidates_more_sensitive_than_d_is_chosen() -> None:
    cells = {
        Candidate(1, 1): [cell(40.0), cell(40.0)],  # D itself is no choice
        Candidate(2, 1): [cell(30.0), cell(31.0)],
        Candidate(1, 2): [cell(29.0), cell(31.0)],
        Candidate(4, 4): [cell(35.0), cell(None)],  # one run is lost: its mean is over other scenes
    }
    chosen = choose(cells)
    assert chosen == Candidate(2, 1)
    text = markdown(cells, chosen, "the command")
    assert "| 2 | 1 | 0.0001 | 0.0002 | 0.001 | 1,000 | 30.50 | - | - | 2 of 2 |" in text
    assert "AbsGS-A: refine.densify.grad_threshold=0.0001, refine.densify.abs_threshold=0.0002" in text
    assert "- run: diverged" in text
    assert choose({Candidate(2, 1): [cell(None)]}) is None
