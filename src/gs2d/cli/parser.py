"""Parses command lines with argparse, from the options of the dataclasses; every mistake becomes one line."""

from __future__ import annotations

import argparse
import difflib
import itertools
import re
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from gs2d.cli.command_line import NAMES, Option, options_of
from gs2d.cli.commands import Common
from gs2d.core.missing import path_hint
from gs2d.pipeline.prepare.options import HowItRuns

HELP_WORDS = ("-h", "--help", "--help-all")
_OVERRIDES = "overrides"  # the field of --set, where a command trains
_ALIKE, _MOST = 0.6, 3  # smallest difflib ratio, and largest number, of proposed words
_NUMBER = re.compile(r"-\.?\d")  # a value, not an option
_CAPTURE = ("", "the input needs no option")
_RUN = ("--out", "use --out for what the command writes")
_SHORTER = ("--schedule-scale", "--schedule-scale 0.1 trains a tenth of the recipe's iterations")
_SMALLER = ("--downscale", "--downscale 2 halves the photographs")
_ELSEWHERE: dict[str, tuple[str, str]] = {  # option of other programs or earlier versions -> our option, advice
    **dict.fromkeys(("-s", "--source-path", "--data", "--data-dir", "--input", "-i"), _CAPTURE),
    **dict.fromkeys(("-m", "--model-path", "-o", "--output", "--output-dir", "--output-path", "--result-dir"), _RUN),
    **dict.fromkeys(("--iterations", "--iters", "--max-steps", "--num-iters", "--steps", "--total-steps"), _SHORTER),
    **dict.fromkeys(("-r", "--resolution", "--data-factor", "--images", "--downscale-factor"), _SMALLER),
    "--eval": ("--test-every", "--test-every 8 holds out every eighth photograph"),
    "--no-page": ("--set", "--set page=false leaves scene.html out"),
    "--refine": ("--no-refine", "meshes of photographs are refined without an option"),
}
_OUTPUTS = ("out", "video", "cache")  # paths that need not exist


class UsageError(Exception):
    """An invalid command line; the message is one line."""


class _Parser(argparse.ArgumentParser):
    """Parser of one command, without help."""

    def __init__(self, options: Sequence[Option], trains: bool) -> None:
        super().__init__(usage="", add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
        self._negative_number_matcher = _NUMBER  # as in Python 3.14; earlier versions read -1e-3 as an option
        for option in options:
            if not option.mark.setting:
                option.add_to(self)
        if not trains and any(option.mark.setting for option in options):
            self.add_argument("--set", dest=_OVERRIDES, action="append")

    def error(self, message: str) -> NoReturn:
        raise UsageError(message.removeprefix("argument "))


def parse(argv: Sequence[str]) -> Common:
    """Return the command of a command line of at least one word. Raises UsageError if the command line is invalid."""
    name, *words = argv
    if name not in NAMES:
        raise UsageError(_with_help(_no_command(name, words), "gs2d --help"))
    try:
        command: Common = NAMES[name](**_field_values(name, words))
    except UsageError as error:
        raise UsageError(_with_help(str(error), f"gs2d {name} --help")) from None
    if isinstance(command, HowItRuns) and command.resume and command.overwrite:
        raise UsageError("--resume and --overwrite exclude each other; use one")
    return command


def _field_values(name: str, words: Sequence[str]) -> dict[str, Any]:
    """Return the values of a command line by field."""
    options = options_of(NAMES[name])
    trains = any(option.field == _OVERRIDES for option in options)  # then --set also changes the recipe
    parsed, rest = _Parser(options, trains).parse_known_intermixed_args(_normalised(words, options))
    if unknown := next((w for w in rest if w.startswith("-") and len(w) > 1 and not _NUMBER.match(w)), None):
        raise UsageError(_no_option(name, unknown.partition("=")[0], options))
    if rest:
        arguments = " ".join(option.usage for option in options if option.mark.positional)
        remedy = "give the folder of the files" if Path(rest[0]).is_file() else "a path with spaces needs quotes"
        takes = f"{arguments} and options; {remedy}" if arguments else "options only"
        raise UsageError(f"unexpected {rest[0]!r}: the command takes {takes}")
    values = {field: value for field, value in vars(parsed).items() if value not in (None, [])}
    values |= _settings(values.pop(_OVERRIDES, ()), options, trains)
    values = {field: tuple(value) if isinstance(value, list) else value for field, value in values.items()}
    if missing := [option.usage for option in options if option.required and option.field not in values]:
        raise UsageError(f"gs2d {name} needs {' and '.join(missing)}")
    return values


def _settings(changes: Sequence[str], options: Sequence[Option], trains: bool) -> dict[str, Any]:
    """Return the values of ``--set`` by field; changes of the recipe stay words."""
    settings = {option.field: option for option in options if option.mark.setting}
    values: dict[str, Any] = {}
    for change in changes:
        name, _, text = change.partition("=")
        if name in settings:
            try:
                values[name] = settings[name].read(text)
            except ValueError as error:
                raise UsageError(str(error)) from None
        elif trains:
            values.setdefault(_OVERRIDES, []).append(change)
        else:
            usage = f"--set NAME=VALUE takes {', '.join(settings)}"
            raise UsageError(f"{usage}; got {change!r}{_meant(name, settings)}")
    return values


def _normalised(words: Sequence[str], options: Sequence[Option]) -> list[str]:
    """Return the words with dashes in options (--schedule_scale), and the value of options that may omit it."""
    normalised = []
    bare = {option.name: option.mark.bare for option in options if option.mark.bare}
    for word, following in itertools.zip_longest(words, words[1:], fillvalue=""):
        flag, equals, value = word.partition("=")
        flag = flag.replace("_", "-") if word.startswith("--") else flag
        if flag in bare and not equals and not following.isdecimal():
            equals, value = "=", bare[flag]
        normalised.append(flag + equals + value)
    return normalised


# -- paths -------------------------------------------------------------------------------------------------------------
def check_inputs(command: Common) -> None:
    """Raise for an input path that does not exist; cheap, so that a misspelt path is reported at once."""
    kind: type = type(command)
    for option in options_of(kind):
        path = getattr(command, option.field)
        if not isinstance(path, Path) or option.field in _OUTPUTS:
            continue
        if option.field == "photos" and getattr(command, "resume", False):
            continue  # not needed after the cameras are estimated
        try:
            path.stat()
        except (FileNotFoundError, NotADirectoryError):
            raise UsageError(f"expected {option.usage} at {path}, found nothing{path_hint(path)}") from None
        except (OSError, ValueError):
            pass  # reported by the reader of the path


# -- messages ----------------------------------------------------------------------------------------------------------
def _with_help(text: str, command: str) -> str:
    return f"{text} See `{command}`" if text.endswith("?") else f"{text}; see `{command}`"


def _no_command(name: str, words: Sequence[str]) -> str:
    """Return the message for an unknown command."""
    if name.startswith("-"):
        command = next((word for word in words if word in NAMES), None)
        if command is not None:
            rest = [word for word in words if word != command]
            return f"options come after the command: gs2d {shlex.join([command, name, *rest])}"
        return f"no option {name}{_meant(name, ('--help', '--help-all', '--version'))}"
    if name.lower() not in NAMES and Path(name).exists():
        return f"{name} is not a command; did you mean `gs2d reconstruct {shlex.quote(name)} --out RUN`?"
    return f"no command {name!r}{_meant(name.lower(), NAMES, 'gs2d ')}"


def _no_option(name: str, flag: str, options: Sequence[Option]) -> str:
    """Return the message for an unknown option: a similar one, or the commands that have it."""
    flags = [word for option in options for word in option.flags]
    here, advice = _ELSEWHERE.get(flag, ("", ""))
    if here in flags or (advice and not here):
        return f"gs2d {name} has no option {flag}; {advice}"
    setting = next((o for o in options if o.mark.setting and o.field == flag.strip("-").replace("-", "_")), None)
    if setting is not None:
        return f"gs2d {name} has no option {flag}; did you mean {setting.usage}?"
    others = [
        f"gs2d {other}"
        for other, command in NAMES.items()
        if any(flag in option.flags for option in options_of(command))
    ]
    if others:
        return f"gs2d {name} has no option {flag}; {_listed(others, 'and')} {'has' if len(others) == 1 else 'have'} one"
    begun = sorted((other for other in flags if other.startswith(flag)), key=len)[:_MOST]
    meant = f"; did you mean {_listed(begun, 'or')}?" if begun else _meant(flag, flags)
    return f"gs2d {name} has no option {flag}{meant}"


def _meant(word: str, candidates: Iterable[str], before: str = "") -> str:
    """Return "; did you mean ...?" with the most similar names, or nothing."""
    plain = {name.lstrip("-"): name for name in candidates}
    close = [plain[name] for name in difflib.get_close_matches(word.lstrip("-"), list(plain), n=2, cutoff=_ALIKE)]
    names = [f"`{before}{name}`" if before else name for name in close]
    return f"; did you mean {_listed(names, 'or')}?" if names else ""


def _listed(names: Sequence[str], last: str) -> str:
    """Return "a, b or c"."""
    return f" {last} ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)
