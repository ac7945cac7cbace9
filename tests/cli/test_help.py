"""Help, the version, and what is said of a command line with a mistake."""

from __future__ import annotations

import dataclasses
import os
import re
import subprocess
import sys

import pytest

import gs2d
from cli_runs import one_line, spawn
from gs2d.cli import run
from gs2d.cli.arguments import NAMES, Option, options_of
from gs2d.cli.help import _FIRST, GROUPS, command_help
from gs2d.cli.layout import message
from gs2d.cli.parser import parse


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("trian here --out there", "no command 'trian'; did you mean `gs2d train`? See `gs2d --help`"),
        ("Viewer", "did you mean `gs2d view`?"),
        ("zzz", "no command 'zzz'; see `gs2d --help`"),
        ("--quiet train here --out there", "options come after the command: gs2d train --quiet here --out there"),
        ("--versoin", "no option --versoin; did you mean --version?"),
        ("train here --out there --recip 2dgs", "gs2d train has no option --recip; did you mean --recipe?"),
        ("train -s here -m there", "no option -s; the input is given without an option"),
        ("train here -o there", "no option -o; use --out for what the command writes"),
        ("train here --out there --iterations 900", "--schedule-scale 0.1 trains a tenth of the recipe's iterations"),
        ("reconstruct here --out there --max_steps 9", "--schedule-scale 0.1 trains a tenth"),
        ("train here --out there --resolution 2", "no option --resolution; --downscale 2 halves the photographs"),
        ("evaluate here --iterations 900", "gs2d evaluate has no option --iterations; see"),
        ("train here --out there --quality best", "--quality: invalid choice: 'best' (choose from"),
        ("train here --out there --zzz", "gs2d train has no option --zzz; see `gs2d train --help`"),
        ("train here --out there --ground-truth a", "gs2d evaluate has one"),
        ("train . --out there --backend gpu", "backend must be one of auto, cpu, cuda, reference, got 'gpu"),
        ("train . --out there --format=colmp", "got 'colmp'; did you mean colmap?"),
        ("paper modlues --data here --out there", "TABLE: invalid choice: 'modlues' (choose from"),
        ("recipes shwo 2dgs", "ACTION: invalid choice: 'shwo' (choose from"),
        ("train", "gs2d train needs SCENE and --out RUN"),
        (
            "train a b --out there",
            "unexpected 'b': the command takes SCENE and options; a path with spaces needs quotes",
        ),
        ("doctor now", "unexpected 'now': the command takes options only"),
        ("train here --out there --downscale two", "--downscale: invalid int value: 'two'"),
        ("mesh here --voxel wide", "--voxel: invalid float value: 'wide'"),
        ("mesh here --bbox 1 2 3", "--bbox: expected 6 arguments"),
        ("train here --out", "--out: expected one argument"),
        ("train here --out there --stage2-cache-mb None", "--stage2-cache-mb: invalid int value: 'None'"),
        ("train here --out there --robust None", "--robust: invalid choice: 'None'"),
        ("train here --out there --resume=yes", "--resume: ignored explicit argument 'yes'"),
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


def test_help_explains_what_comes_first_and_counts_the_rest_and_help_all_explains_all() -> None:
    for name, command in NAMES.items():
        short, whole = command_help(name), "\n".join(command_help(name, everything=True))
        explained = [option for option in options_of(command) if any(f"  {option.usage}" in line for line in short)]
        more = len(options_of(command)) - len(explained)
        assert short[-1] == f"{more} more options: gs2d {name} --help-all"
        for option in options_of(command):
            assert len(re.findall(rf"\n  {re.escape(option.usage)}(?:\n|  )", whole)) == 1, option
            assert option.about, option
    assert set(_FIRST) <= set(NAMES)
    assert "matching" not in "\n".join(command_help("reconstruct"))


def test_every_option_is_parsed_and_fills_its_field() -> None:
    for name, command in NAMES.items():
        options = options_of(command)
        for option in options:
            given = sorted(
                (o for o in options if o.required or not o.flags or o is option), key=lambda o: bool(o.flags)
            )
            parsed = parse([name, *(word for other in given for word in written(other))])
            assert option.default not in values_of(parsed, option.field), option
    assert "--no-page" in {flag for option in options_of(NAMES["train"]) for flag in option.flags}


def written(option: Option) -> list[str]:
    """An option with a value that is not its default, in words."""
    value = option.choices[-1] if option.choices else "-1.5e-1" if option.kind is float else "97"
    values = [] if option.kind is bool else [value] * (option.count or 2)
    return [*option.flags[-1:], *values]


def values_of(parsed: object, field: str) -> list[object]:
    """The values of a field of this name, also in nested options."""
    nested = [value for value in vars(parsed).values() if dataclasses.is_dataclass(value)]
    return [vars(part)[field] for part in (parsed, *nested) if field in vars(part)]


@pytest.mark.parametrize(
    ("words", "field", "value"),
    [
        ("mesh run --bbox -1 -1e-3 -.5 1 1 1", "bbox", (-1, -0.001, -0.5, 1, 1, 1)),
        ("train in --out out --seed 1 --seed=2", "seed", 2),
        ("train in --out out --set a=1 --set b=-2", "overrides", ("a=1", "b=-2")),
        ("train in --out out --schedule_scale 0.5", "schedule_scale", 0.5),
        ("train in --no-page --out out", "page", False),
        ("recipes --json show 2dgs", "name", "2dgs"),
        ("sweep a --data here --out there b", "recipes", ("a", "b")),
        ("blocks in --out out --jobs 3", "slots", 3),
    ],
)
def test_words_become_values(words: str, field: str, value: object) -> None:
    assert getattr(parse(words.split()), field) == value


@pytest.mark.parametrize("words", ["--version", "-V", "version", "train --version"])
def test_version_is_that_of_the_package(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words.split()) == 0
    assert capsys.readouterr().out == f"gs2d {gs2d.__version__}\n"


def test_a_terminal_without_boxes_gets_the_same_one_line() -> None:
    done = spawn(["train", "here", "--lol"], env={**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"})
    assert done.returncode == 2
    assert "--lol" in one_line(done.stderr)


def test_a_message_breaks_between_words_and_its_commands_stay_whole() -> None:
    text = "the run is not finished, continue it with `gs2d train photographs --out runs/one --resume`, or start anew"
    lines = message(text, 40)
    assert "`gs2d train photographs --out runs/one --resume`," in [line.strip() for line in lines]
    assert all(len(line) <= 40 for line in lines if "`" not in line)
    assert " ".join(line.strip() for line in lines) == text
