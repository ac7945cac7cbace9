"""Help, the version, and what is said of a command line with a mistake."""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import tyro

import gs2d
from cli_runs import one_line, spawn
from gs2d.cli import run
from gs2d.cli.catalogue import options_of
from gs2d.cli.help import _FIRST, GROUPS, command_help
from gs2d.cli.layout import message
from gs2d.cli.usage import NAMES


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("trian here --out there", "no command 'trian'; did you mean `gs2d train`? See `gs2d --help`"),
        ("Viewer", "did you mean `gs2d view`?"),
        ("zzz", "no command 'zzz'; see `gs2d --help`"),
        ("--quiet train here --out there", "options come after the command: gs2d train --quiet here --out there"),
        ("--versoin", "no option --versoin; did you mean --version?"),
        ("train here --out there --recip 2dgs", "gs2d train has no option --recip; did you mean --recipe?"),
        ("train -s here -m there", "no option -s; what is read stands alone, without an option"),
        ("train here -o there", "no option -o; what is made goes to --out"),
        ("train here --out there --iterations 900", "--schedule-scale 0.1 trains a tenth of the recipe's iterations"),
        ("reconstruct here --out there --max_steps 9", "--schedule-scale 0.1 trains a tenth"),
        ("train here --out there --resolution 2", "no option --resolution; --downscale 2 halves the photographs"),
        ("evaluate here --iterations 900", "gs2d evaluate has no option --iterations; see"),
        ("train here --out there --quality best", "--quality must be draft, normal or full, got 'best'"),
        ("train here --out there --zzz", "gs2d train has no option --zzz; see `gs2d train --help`"),
        ("train here --out there --ground-truth a", "gs2d evaluate has one"),
        ("train . --out there --backend gpu", "backend must be one of auto, cpu, cuda, reference, got 'gpu"),
        ("train . --out there --format=colmp", "got 'colmp'; did you mean colmap?"),
        ("paper modlues --data here --out there", "got 'modlues'; did you mean modules?"),
        ("recipes shwo 2dgs", "ACTION must be list or show, got 'shwo'; did you mean show?"),
        ("train", "gs2d train needs SCENE and --out RUN"),
        ("train a b --out there", "what is 'b'? The command takes SCENE and options"),
        (
            "train my scan --out there",
            "takes SCENE and options; a path with spaces needs quotes",
        ),
        (
            "train here --out my run",
            "what is 'run'? The command takes SCENE and options; a path with",
        ),
        ("doctor now", "what is 'now'? The command takes options only"),
        ("train here --out there --downscale two", "--downscale must be a whole number, got 'two'"),
        ("mesh here --voxel wide", "--voxel must be a number, got 'wide'"),
        ("mesh here --bbox 1 2 3", "--bbox needs 6 numbers, got 3"),
        ("train here --out", "--out needs a value: --out RUN"),
        ("train here --out there --stage2-cache-mb None", "--stage2-cache-mb must be a whole number, got 'None'"),
        ("train here --out there --robust None", "--robust must be auto, on or off, got 'None'"),
        ("train here --out there --resume=yes", "--resume takes no value, got 'yes'"),
        ("train here --out there --resume --overwrite", "exclude each other"),
    ],
)
def test_a_command_line_with_a_mistake_is_one_line_that_says_what_was_meant(
    words: str, named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert named in one_line(err)


def test_a_path_with_spaces_that_is_there_is_quoted_in_the_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my own scan").mkdir()
    monkeypatch.chdir(tmp_path)
    assert run("train --out there my own scan --seed 3".split()) == 2
    line = one_line(capsys.readouterr().err)
    assert line.endswith("options; a path with spaces needs quotes: 'my own scan'; see `gs2d train --help`")


def test_a_folder_in_the_place_of_a_command_is_photographs(
    tmp_path: object, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([str(tmp_path)]) == 2
    assert f"did you mean `gs2d reconstruct {tmp_path} --out RUN`?" in one_line(capsys.readouterr().err)


def test_help_is_instant_because_it_does_not_import_torch() -> None:
    code = "import sys; from gs2d.cli import run; run(['--help']); run(['train', '--help']); run(['recipes']); "
    code += "run(['--help-all']); assert 'torch' not in sys.modules; assert 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("words", ["--help", "-h", "help", "", "train --help", "help train", "train a --help --out b"])
def test_help_exits_with_0(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words.split()) == 0
    assert "usage: gs2d" in capsys.readouterr().out


def test_gs2d_alone_shows_the_commands_of_a_first_day_and_help_shows_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert run([]) == 0
    first = capsys.readouterr().out
    assert run(["--help"]) == 0
    whole = capsys.readouterr().out
    shown = [name for name in NAMES if f"gs2d {name}" in first]
    assert shown == ["demo", "reconstruct", "mesh", "view", "doctor"]
    assert "reconstruct" in shown
    assert "--version" in whole
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(NAMES)
    assert all(f"\n  {name} " in whole for name in NAMES)


@pytest.mark.parametrize("width", [60, 80])
def test_no_line_of_any_help_is_wider_than_the_terminal(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    for words in ([], ["--help"], ["--help-all"]):
        assert run(words) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line for line in lines if len(line) > width] == []


def test_help_explains_what_comes_first_and_names_the_rest_and_help_all_explains_all() -> None:
    for name, command in NAMES.items():
        short, whole = "\n".join(command_help(name)), "\n".join(command_help(name, everything=True))
        for option in options_of(command):
            assert option.name in short
            assert len(re.findall(rf"\n  {re.escape(option.usage)}(?:\n|  )", whole)) == 1, option
            assert option.about, option
    assert set(_FIRST) <= set(NAMES)
    assert "matching" not in "\n".join(command_help("reconstruct")).partition("Also")[0]


def test_the_catalogue_is_what_tyro_parses() -> None:
    for name, command in NAMES.items():
        shown = io.StringIO()
        with contextlib.redirect_stdout(shown), pytest.raises(SystemExit):
            tyro.cli(command, prog="gs2d", args=["--help"], config=(tyro.conf.FlagCreatePairsOff,))
        lines = [line.strip(" |\u2502") for line in shown.getvalue().splitlines()]
        heads = [line.partition("  ")[0] for line in lines if line.startswith("-")]
        flags = {flag for head in heads for flag in re.findall(r"(--[a-z][a-z0-9-]+)", head)}
        known = {flag for option in options_of(command) for flag in option.flags}
        assert flags - {"--help"} == known, name
    assert "--no-page" in {flag for option in options_of(NAMES["train"]) for flag in option.flags}


@pytest.mark.parametrize("words", ["--version", "-V", "version", "train --version"])
def test_version_is_that_of_the_package(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words.split()) == 0
    assert capsys.readouterr().out == f"gs2d {gs2d.__version__}\n"


def test_a_terminal_without_boxes_gets_the_same_one_line() -> None:
    done = spawn(["train", "here", "--lol"], env={**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"})
    assert done.returncode == 2
    assert "--lol" in one_line(done.stderr)


def test_completions_of_a_shell_are_still_of_all_commands(capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["--tyro-print-completion", "bash"]) == 0
    out = capfd.readouterr().out
    assert all(name in out for name in NAMES)


def test_a_message_breaks_between_words_and_its_commands_stay_whole() -> None:
    text = "the run is not finished, continue it with `gs2d train photographs --out runs/one --resume`, or start anew"
    lines = message(text, 40)
    assert "`gs2d train photographs --out runs/one --resume`," in [line.strip() for line in lines]
    assert all(len(line) <= 40 for line in lines if "`" not in line)
    assert " ".join(line.strip() for line in lines) == text
