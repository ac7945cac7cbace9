"""`gs2d sweep`: a table whose rows are the recipes that the command line names."""

from __future__ import annotations

import csv
import json
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from gs2d.cli import run
from gs2d.cli.commands import Sweep
from gs2d.cli.parser import parse
from gs2d.config.presets import get_recipe
from gs2d.config.serialize import to_json
from gs2d.contrib.lab import jobs as jobs_module
from gs2d.contrib.lab.aggregate import Results
from gs2d.contrib.lab.deviations import deviations_of
from gs2d.contrib.lab.options import SweepOptions
from gs2d.contrib.lab.paper import paper
from gs2d.contrib.lab.plan import make_plan, paper_command
from gs2d.pipeline.prepare.options import values
from paper_cells import TINY, draw_nothing
from tiny import write_capture


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, list[str], int]]:
    """2DGS on a ball, then a second command that names 2DGS-R only: the folder, that command, when 2DGS was written."""
    folder = tmp_path_factory.mktemp("sweep")
    write_capture(folder / "data" / "ball", train=3, test=1, size=20)
    words = ["--data", str(folder / "data"), "--out", str(folder / "out"), "--threads", "1", "--quiet", *TINY]
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        assert run(["sweep", "2dgs", *words]) == 0
        written = (folder / "out" / "runs" / "ball-2dgs-s0" / "splats.ply").stat().st_mtime_ns
        assert run(["sweep", "2dgs-r", *words]) == 0
        yield folder / "out", ["sweep", "2dgs-r", *words], written


def test_the_table_has_a_row_for_each_recipe_with_its_figures(swept: tuple[Path, list[str], int]) -> None:
    rows = json.loads((swept[0] / "table.json").read_text())
    assert [(row["name"], row["recipe"]) for row in rows] == [("2dgs", "2dgs"), ("2dgs-r", "2dgs-r")]
    for row in rows:
        assert row["paper"] == {}
        assert row["mean"]["psnr"] > 0
        assert [(cell["scene"], cell["seed"]) for cell in row["scenes"]] == [("ball", 0)]
    for name in ("table.md", "table.tex", "table.csv", "index.html"):
        assert "2dgs-r" in (swept[0] / name).read_text()


def test_nothing_of_the_paper_stands_in_it(swept: tuple[Path, list[str], int]) -> None:
    out = swept[0]
    assert "paper" not in (out / "table.tex").read_text()
    assert "paper_psnr" not in next(csv.reader((out / "table.csv").read_text().splitlines()))
    for name in ("table.md", "index.html"):
        text = (out / name).read_text()
        assert "What to know about these figures" in text
        assert "the schedule is 0.0005 of the paper" in text  # what a recipe is defined by
        phrases = ("claims", "In brackets", "In small print", "differs from", "paper&#39;s figure", "RTX 4090")
        for phrase in (*phrases, "gs2d paper"):
            assert phrase not in text
    assert "2DGS with normal consistency 0.05: the paper&#39;s baseline" in (out / "index.html").read_text()
    assert '<p class="lead">2 recipes on 1 scene. Trained at 0.0005 of the schedule' in (out / "index.html").read_text()
    assert json.loads((out / "about.json").read_text())["claims"] == []


def test_another_recipe_adds_a_row_and_trains_only_what_is_new(swept: tuple[Path, list[str], int]) -> None:
    out, _, written = swept
    assert (out / "runs" / "ball-2dgs-s0" / "splats.ply").stat().st_mtime_ns == written
    stages = json.loads((out / "runs" / "ball-2dgs-r-s0" / "metrics.json").read_text())["stages"]
    assert [stage.get("reused_from") is not None for stage in stages] == [True, False, False]  # stage 1 of 2DGS
    about = json.loads((out / "about.json").read_text())
    assert about["recipes"] == ["2dgs", "2dgs-r"]
    assert shlex.split(about["command"])[:4] == ["gs2d", "sweep", "2dgs", "2dgs-r"]


def test_the_rows_that_were_there_are_named_and_the_same_command_does_nothing_again(
    swept: tuple[Path, list[str], int], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    draw_nothing(monkeypatch)
    monkeypatch.setattr(jobs_module, "train_and_evaluate", lambda *_: pytest.fail("trained again"))
    words = [word for word in swept[1] if word != "--quiet"]
    assert run([*words, "--json"]) == 0
    said = capsys.readouterr()
    assert [row["name"] for row in json.loads(said.out)["rows"]] == ["2dgs", "2dgs-r"]
    assert f"{swept[0]} has rows of earlier commands, which stay: 2dgs" in said.err


def test_the_table_of_what_is_there_can_be_written_while_a_command_trains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_capture(tmp_path / "ball", train=2, test=1, size=8)
    mine = SweepOptions(recipes=("2dgs",), data=tmp_path / "ball", out=tmp_path / "out")
    found: list[int] = []

    def train(*_: object) -> dict[str, str]:
        found.append(paper(replace(mine, train=False)).unfinished)
        return {}

    monkeypatch.setattr(jobs_module, "train_and_evaluate", train)
    assert paper(mine).unfinished == 0
    assert found == [1]


def test_a_recipe_that_is_named_twice_is_trained_once(tmp_path: Path) -> None:
    write_capture(tmp_path / "ball", train=2, test=1, size=8)
    recipes = ("2dgs-r", "2dgs", "2dgs-r")
    plan = make_plan(SweepOptions(recipes=recipes, data=tmp_path, out=tmp_path / "out", seeds=(4,)))
    assert [row.name for row in plan.table.rows] == ["2dgs-r", "2dgs"]
    assert [job.name for job in plan.jobs] == ["ball-2dgs-r-s4", "ball-2dgs-s4"]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["2dgs", "2dgs-rr"], "no recipe '2dgs-rr'; there is 2dgs-r, "),
        ([], "gs2d sweep needs RECIPE [RECIPE ...]; see `gs2d sweep --help`"),
        (["2dgs", "--set", "refine.iterations=5"], "--set refine.iterations=5 fits no recipe of the table"),
    ],
)
def test_recipes_that_cannot_be_trained_are_one_line_and_nothing_is_written(
    words: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_capture(tmp_path / "ball", train=2, test=1, size=8)
    assert run(["sweep", *words, "--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert named in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("first", ["paper", "sweep"])
def test_a_folder_holds_a_sweep_or_a_table_of_the_paper(
    first: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_capture(tmp_path / "ball", train=2, test=1, size=8)
    words = ["--data", str(tmp_path), "--out", str(tmp_path / "out"), "--no-train", "--quiet"]
    commands = {"paper": ["paper", "modules", *words], "sweep": ["sweep", "2dgs", *words]}
    assert run(commands.pop(first)) == 0
    assert run(commands.popitem()[1]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    kinds = ("modules", "sweep") if first == "paper" else ("sweep", "modules")
    assert "holds a table made with table = {}, now {}; choose another --out".format(*kinds) in line


def test_the_printed_command_is_the_one_that_was_given() -> None:
    options = SweepOptions(
        recipes=("2dgs", "2dgs-r"),
        data=Path("a b"),
        out=Path("out"),
        scenes=("lego", "ship"),
        seeds=(3,),
        schedule_scale=0.1,
        downscale=2,
        protocol="generic",
        cache=Path("c"),
        overrides=("surface.iterations=9",),
    )
    command = parse(shlex.split(paper_command(options))[1:])
    assert isinstance(command, Sweep)
    assert values(SweepOptions, command) == values(SweepOptions, options)


def test_scenes_that_only_the_paper_would_need_are_not_missed(tmp_path: Path) -> None:
    write_capture(tmp_path / "lego", train=2, test=1, size=8)
    options = SweepOptions(recipes=("2dgs-r",), data=tmp_path, out=tmp_path / "out")
    plan = make_plan(options)
    lines = deviations_of(options, plan.scenes, plan.table, Results(()))
    assert not any("of its 8 scenes are not here" in line or "the paper does not say" in line for line in lines)
    assert "1 seed (0)" in lines


def test_recipes_of_files_are_rows_by_their_short_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    draw_nothing(monkeypatch)
    write_capture(tmp_path / "data" / "ball", train=3, test=1, size=20)
    stage = replace(get_recipe("2dgs").stages[0], sh_interval=77)
    (tmp_path / "mine.json").write_text(json.dumps(to_json(replace(get_recipe("2dgs"), name="m", stages=(stage,)))))
    words = ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "out"), "--threads", "1", "--quiet", *TINY]
    assert run(["sweep", str(tmp_path / "mine.json"), "2dgs", *words]) == 0
    rows = json.loads((tmp_path / "out" / "table.json").read_text())
    assert [(row["name"], row["recipe"]) for row in rows] == [("mine", str(tmp_path / "mine.json")), ("2dgs", "2dgs")]
    assert rows[0]["mean"]["psnr"] > 0
    assert sorted(path.name for path in (tmp_path / "out" / "runs").iterdir()) == ["ball-2dgs-s0", "ball-mine-s0"]
    (tmp_path / "mine.py").write_text("from gs2d.config.presets import two_dgs\n\nmine = two_dgs()\n")
    capsys.readouterr()
    assert run(["sweep", f"{tmp_path}/mine.py:mine", *words]) == 2
    assert "each recipe of a sweep needs a name of its own, got 'mine' from" in capsys.readouterr().err
