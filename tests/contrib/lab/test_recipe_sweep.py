"""`gs2d sweep`: a table whose rows are the recipes that the command line names."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from gs2d.cli import run
from gs2d.config.presets import get_recipe
from gs2d.config.serialize import to_json
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
    for name in ("table.md", "index.html"):
        assert "2dgs-r" in (swept[0] / name).read_text()


def test_another_recipe_adds_a_row_and_trains_only_what_is_new(swept: tuple[Path, list[str], int]) -> None:
    out, _, written = swept
    assert (out / "runs" / "ball-2dgs-s0" / "splats.ply").stat().st_mtime_ns == written
    stages = json.loads((out / "runs" / "ball-2dgs-r-s0" / "metrics.json").read_text())["stages"]
    assert [stage.get("reused_from") is not None for stage in stages] == [True, False, False]  # stage 1 of 2DGS
    about = json.loads((out / "about.json").read_text())
    assert about["recipes"] == ["2dgs", "2dgs-r"]
    assert shlex.split(about["command"])[:4] == ["gs2d", "sweep", "2dgs", "2dgs-r"]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["module"], "no recipe and no table of the paper 'module'; did you mean modules?"),
        (["2dgs", "2dgs-rr"], "no recipe '2dgs-rr'; `gs2d recipes --all` lists them; did you mean 2dgs-r?"),
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
    commands = {"paper": ["sweep", "modules", *words], "sweep": ["sweep", "2dgs", *words]}
    assert run(commands.pop(first)) == 0
    assert run(commands.popitem()[1]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    kinds = ("modules", "sweep") if first == "paper" else ("sweep", "modules")
    assert "holds a table made with table = {}, now {}; choose another --out".format(*kinds) in line


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
