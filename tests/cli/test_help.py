"""Help, version, and errors of the command line."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest

import gs2d
from cli_runs import one_line
from gs2d.cli import run
from gs2d.cli.command_line import NAMES, Option, options_of
from gs2d.cli.parser import parse


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("trian here --out there", "gs2d train"),
        ("--quiet train here --out there", "gs2d train --quiet"),
        ("--versoin", "--version"),
        ("train here --out there --recip 2dgs", "--recipe?"),
        ("train -s here -m there", "no option -s"),
        ("train here -o there", "--out"),
        ("train here --out there --iterations 900", "--schedule-scale"),
        ("train here --out there --resolution 2", "--downscale"),
        ("train here --out there --quality best", "--quality"),
        ("train here --out there --ground-truth a", "gs2d evaluate"),
        ("train . --out there --backend gpu", "reference"),
        ("train . --out there --format=colmp", "colmap"),
        ("recipes 2dgs-rr", "2dgs-r"),
        ("train", "CAPTURE"),
        ("train a b --out there", "'b'"),
        ("train here --out there --downscale two", "--downscale"),
        ("mesh here --bbox 1 2 3", "--bbox"),
        ("mesh here --faces 9", "--set faces=N"),
        ("mesh here --set facets=9", "did you mean faces?"),
        ("mesh here --set faces=many", "got 'many'"),
        ("train here --out", "--out"),
        ("train here --out there --resume --overwrite", "exclude each other"),
    ],
)
def test_a_mistyped_command_line_gives_one_line_with_a_suggestion(
    words: str, named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert named in one_line(err)


def test_several_files_instead_of_a_folder_suggest_the_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(tmp_path / name) for name in ("a.jpg", "b.jpg")]
    for file in files:
        Path(file).touch()
    assert run(["reconstruct", *files, "--out", "there"]) == 2
    assert "give the folder of the files" in one_line(capsys.readouterr().err)
    assert run(["reconstruct", "my", "photographs", "--out", "there"]) == 2
    assert "a path with spaces needs quotes" in one_line(capsys.readouterr().err)


def test_a_folder_instead_of_a_command_suggests_reconstruct(
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


@pytest.mark.parametrize("name", ["", *NAMES])
def test_help_fits_a_small_terminal_and_counts_the_other_options(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run([*name.split(), "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 80
    if name:
        assert re.fullmatch(r"\d+ more options: --help-all", lines[-1])
        assert run([name, "--help-all"]) == 0
        whole = capsys.readouterr().out
        assert all(option.name in whole for option in options_of(NAMES[name]))


def test_every_option_is_parsed_and_fills_its_field() -> None:
    for name, command in NAMES.items():
        options = options_of(command)
        for option in options:
            needed = sorted(
                (o for o in options if o.required or o.mark.positional or o is option),
                key=lambda o: not o.mark.positional,
            )
            parsed = parse([name, *(word for other in needed for word in written(other))])
            assert option.default not in values_of(parsed, option.field), option
    assert "--no-refine" in {flag for option in options_of(NAMES["mesh"]) for flag in option.flags}


def test_options_have_the_same_defaults_in_every_command() -> None:
    """But for --out, --format of `export` and --schedule-scale of `sweep`, which has no --quality."""
    defaults: dict[str, set[object]] = {}
    for name, command in NAMES.items():
        for option in options_of(command):
            if option.flags and option.field != "out" and (name, option.name) not in DIFFERENT:
                defaults.setdefault(option.name, set()).add(option.default)
    assert {name: values for name, values in defaults.items() if len(values) > 1} == {}


DIFFERENT = {("export", "--format"), ("sweep", "--schedule-scale")}


def written(option: Option) -> list[str]:
    """An option with a value that is not its default, in words."""
    value = option.choices[-1] if option.choices else "-1.5e-1" if option.kind is float else "97"
    if option.mark.setting:
        value = str(not option.default).lower() if option.kind is bool else value
        return ["--set", f"{option.field}={','.join([value] * (option.count or 2))}"]
    values = [] if option.kind is bool else [value] * (option.count or 2)
    return [*option.flags, *values]


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
        ("train in --set page=false --out out", "page", False),
        ("recipes --json 2dgs", "name", "2dgs"),
        ("sweep a --data here --out there b", "recipes", ("a", "b")),
        ("train in --out out --viewer", "viewer", 0),
        ("train --viewer in --out out", "viewer", 0),
        ("train --viewer 81 in --out out", "viewer", 81),
        ("mesh run --set depth=median --set faces=9", "faces", 9),
        ("survey run --set up=0,1,0", "up", (0, 1, 0)),
    ],
)
def test_option_words_become_values(words: str, field: str, value: object) -> None:
    assert getattr(parse(words.split()), field) == value


@pytest.mark.parametrize("words", ["--version", "-V", "version", "train --version"])
def test_version_is_that_of_the_package(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words.split()) == 0
    assert capsys.readouterr().out == f"gs2d {gs2d.__version__}\n"
