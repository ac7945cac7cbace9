"""Tables of the paper: scenes found, rows averaged, claims judged, tables written, failures named."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gs2d.cli import run
from gs2d.contrib.lab import training_task as task_module
from gs2d.contrib.lab.aggregate import FIGURES, Results, Row, check_claim
from gs2d.contrib.lab.lab_options import SweepOptions
from gs2d.contrib.lab.paper import paper
from gs2d.contrib.lab.paper_tables import PAPER_TABLES, TNT, Claim, recipe_table
from gs2d.contrib.lab.render import parts_of, to_markdown
from gs2d.contrib.lab.scenes import find_scenes, missing_scenes
from gs2d.contrib.lab.table_plan import make_plan
from gs2d.errors import DataError, RunError
from paper_cells import TINY, draw_nothing, make_cell, make_row
from tiny import write_ball_mesh, write_capture


# -- scenes --------------------------------------------------------------------------------------------------------
@pytest.fixture
def captures(tmp_path: Path) -> Path:
    """lego and a ball (with its surface), one folder down."""
    for name in ("nerf_synthetic_lego", "ball"):
        write_capture(tmp_path / "unpacked" / name, train=2, test=1, size=8)
    write_ball_mesh(tmp_path / "unpacked" / "ball" / "mesh_gt.ply", rings=4)
    return tmp_path


def test_scenes_are_found_with_their_data_set_and_ground_truth(captures: Path) -> None:
    ball, lego = find_scenes(captures)
    assert (ball.name, ball.data_set, ball.protocol.name) == ("ball", "other (nerf-synthetic)", "nerf-synthetic")
    assert ball.truth == ball.path / "mesh_gt.ply"
    assert (lego.name, lego.scene, lego.data_set) == ("nerf_synthetic_lego", "lego", "NeRF-Synthetic")
    assert not lego.scored
    assert "mesh_gt.ply is missing (to score the surface)" in lego.missing[0]
    absent, count = missing_scenes((ball, lego))["NeRF-Synthetic"]
    assert (absent[:2], len(absent), count) == (["chair", "drums"], 7, 8)


# -- plans ---------------------------------------------------------------------------------------------------------
def test_rows_share_stages_that_train_the_same(captures: Path) -> None:
    plan = make_plan(
        SweepOptions(recipes=("modules",), data=captures, out=captures / "out", scenes=("ball",), seeds=(0, 1))
    )
    by_name = {job.name: job for job in plan.tasks}
    assert list(by_name)[:4] == [
        "ball-2dgs-s0",
        "ball-2dgs-r-module-ii-s0",
        "ball-2dgs-r-module-iii-s0",
        "ball-2dgs-r-s0",
    ]
    i, ii, iv = (by_name[f"ball-{name}-s0"].stage_keys for name in ("2dgs", "2dgs-r-module-ii", "2dgs-r"))
    assert i == ii[:1]  # stage 1 is everybody's
    assert ii[:2] == iv[:2]
    assert ii[2] != iv[2]
    assert not set(i) & set(by_name["ball-2dgs-s1"].stage_keys)  # another seed is another training


def test_the_spread_is_over_seeds_of_the_mean_over_scenes() -> None:
    cells = [make_cell(scene, seed, psnr=value) for scene, seed, value in [("a", 0, 30.0), ("b", 0, 20.0)]]
    cells += [make_cell("a", 1, psnr=31.0), make_cell("b", 1, psnr=23.0)]
    row = make_row("row", *cells)
    results = Results((row,))
    # Means 25 and 27: their standard deviation is sqrt(((25 - 26)^2 + (27 - 26)^2) / 1) = 1.41421.
    assert results.mean(row)["psnr"] == 26.0
    assert results.spread(row)["psnr"] == pytest.approx(2**0.5)
    (part,) = parts_of(recipe_table(["row"]), results)
    assert part.rows[0].figures[part.columns.index("psnr")].measured == "26.00 ± 1.41"
    assert Results((make_row("one", make_cell(psnr=1.0)),)).spread(make_row("one", make_cell(psnr=1.0)))["psnr"] is None


# -- claims --------------------------------------------------------------------------------------------------------
def rows_of(metric: str = "psnr", data_set: str = TNT, **values: list[float]) -> tuple[Row, ...]:
    """A row for each name, with a value for each seed."""
    return tuple(
        make_row(name, *(make_cell("a", seed, data_set, **{metric: value}) for seed, value in enumerate(by_seed)))
        for name, by_seed in values.items()
    )


@pytest.mark.parametrize(
    ("low", "high", "holds"),
    [([1, 2], [2, 3], "yes"), ([2, 3], [1, 2], "no"), ([1, 3], [2, 2], "open")],
)
def test_an_order_holds_if_it_does_at_every_seed(low: list[float], high: list[float], holds: str) -> None:
    claim = check_claim(Claim("claim", "psnr", ("low", "high")), rows_of(low=low, high=high), TNT)
    assert claim.holds == holds
    (step,) = claim.steps
    assert step.difference == (high[0] - low[0] + high[1] - low[1]) / 2


# -- files ---------------------------------------------------------------------------------------------------------
def test_tables_show_the_measured_figures_with_the_papers_in_brackets() -> None:
    table = PAPER_TABLES["modules"]
    cells = {"(I)": 24.0, "(II)": 25.0, "(III)": 25.5, "(IV)": 24.5}
    rows = tuple(
        make_row(row.name, make_cell(psnr=cells[row.name], bytes=2e6, seconds=60.0), paper=row.paper)
        for row in table.rows
    )
    results = Results(rows)
    text = to_markdown(table, results, (), ["half the schedule"], ["gs2d train"])
    assert "| (I) | - (0.33) | 24.00 (24.30) | 2.00 | 60 |" in text
    assert "| (III) | - (0.26) | **25.50** (24.89) | 2.00 | 60 |" in text
    assert "- half the schedule" in text


# -- the command ---------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, list[str]]]:
    """The modules table of a ball, and of a capture with a broken photograph; and the command."""
    folder = tmp_path_factory.mktemp("paper")
    for name in ("ball", "broken"):
        write_capture(folder / "data" / name, train=3, test=1, size=20)
    (folder / "data" / "broken" / "train" / "r_1.png").write_bytes(b"no picture")
    words = ["sweep", "modules", "--data", str(folder / "data"), "--out", str(folder / "out"), "--threads", "1", *TINY]
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        assert run([*words, "--quiet"]) == 2
        yield folder / "out", words


def test_the_table_is_a_list_of_rows_in_the_papers_order(finished: tuple[Path, list[str]]) -> None:
    rows = json.loads((finished[0] / "table.json").read_text())
    assert [row["name"] for row in rows] == ["(I)", "(II)", "(III)", "(IV)"]
    for row in rows:
        assert set(FIGURES) <= row["mean"].keys()
        assert row["mean"]["psnr"] > 0
        assert row["mean"]["bytes"] > 0
        assert row["paper"]["TnT"]["psnr"] > 24
        assert any("the schedule is 0.0005 of the paper's" in text for text in row["deviations"])
    # Stage 1 was trained once, and its seconds count in every row.
    firsts = [next(c for c in row["scenes"] if c["scene"] == "ball")["stages"][0]["seconds"] for row in rows]
    assert len(set(firsts)) == 1
    assert "(III)" in (finished[0] / "table.md").read_text()


def test_a_broken_scene_leaves_null_with_the_reason_and_the_others_go_on(finished: tuple[Path, list[str]]) -> None:
    rows = json.loads((finished[0] / "table.json").read_text())
    cells = [cell for row in rows for cell in row["scenes"] if cell["scene"] == "broken"]
    assert len(cells) == 4
    for cell in cells:
        assert cell["psnr"] is None
        assert "r_1.png" in cell["reasons"]["psnr"]
    about = json.loads((finished[0] / "about.json").read_text())
    assert set(about["failures"]) == {
        f"broken-{name}-s0" for name in ("2dgs", "2dgs-r", "2dgs-r-module-ii", "2dgs-r-module-iii")
    }
    (line,) = [text for text in about["deviations"] if "failed" in text]
    assert line.startswith("broken: failed for (I) (seed 0), (II) (seed 0), (III) (seed 0), (IV) (seed 0): ")


def test_what_is_done_is_not_done_again(
    finished: tuple[Path, list[str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, words = finished
    tried: list[str] = []

    def train(job: task_module.TrainingTask, _on_event: object) -> dict[str, str]:
        tried.append(job.name)
        raise DataError("still broken")

    monkeypatch.setattr(task_module, "train_and_evaluate", train)
    before = (out / "runs" / "ball-2dgs-s0" / "splats.ply").stat().st_mtime_ns
    assert run([*words, "--json"]) == 2
    assert len(tried) == 4
    assert all(name.startswith("broken") for name in tried)
    assert (out / "runs" / "ball-2dgs-s0" / "splats.ply").stat().st_mtime_ns == before
    said = capsys.readouterr()
    assert json.loads(said.out)["rows"][0]["name"] == "(I)"
    assert said.err.splitlines()[-1].startswith(
        "error: 4 of the runs failed; the table lacks their figures: broken-2dgs"
    )


@pytest.mark.slow
def test_a_command_killed_at_any_moment_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    write_capture(tmp_path / "data" / "ball", train=3, test=1, size=20)
    words = ["sweep", "modules", "--data", str(tmp_path / "data"), "--threads", "1", *TINY, "--quiet", "--out"]
    killed, undisturbed = tmp_path / "killed", tmp_path / "undisturbed"
    records = killed / "jobs"
    with subprocess.Popen([sys.executable, "-m", "gs2d", *words, str(killed)]) as process:
        while process.poll() is None and not (records / "ball-2dgs-r-module-ii-s0.json").exists():
            time.sleep(0.01)
        time.sleep(0.3)  # somewhere in the second job
        process.send_signal(signal.SIGKILL)
    assert json.loads((records / "ball-2dgs-s0.json").read_text())["state"] == "done"
    assert not (records / "ball-2dgs-r-s0.json").exists()
    assert run([*words, str(killed)]) == run([*words, str(undisturbed)]) == 0
    for name in ("ball-2dgs-s0", "ball-2dgs-r-module-ii-s0", "ball-2dgs-r-module-iii-s0", "ball-2dgs-r-s0"):
        found = [(out / "runs" / name / "splats.ply").read_bytes() for out in (killed, undisturbed)]
        assert found[0] == found[1]
    tables = [json.loads((out / "table.json").read_text()) for out in (killed, undisturbed)]
    assert [row["mean"]["psnr"] for row in tables[0]] == [row["mean"]["psnr"] for row in tables[1]]


def test_a_folder_made_with_other_options_is_refused(finished: tuple[Path, list[str]]) -> None:
    out, words = finished
    options = SweepOptions(recipes=("modules",), data=Path(words[3]), out=out, schedule_scale=0.1)
    with pytest.raises(RunError, match="made with schedule_scale = 0.0005, now 0.1"):
        paper(options)
