"""The command line: argparse with the options of the dataclasses, and one line for each mistake."""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import itertools
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from gs2d.cli.command_line import NAMES, Option, fields_of, options_of
from gs2d.cli.commands import Common
from gs2d.core.missing import where_it_ends
from gs2d.pipeline.prepare.options import HowItRuns

HELP_WORDS = ("-h", "--help", "--help-all")
_OVERRIDES = "overrides"  # the field of --set, where a command trains
_ALIKE = 0.6  # difflib's ratio from which a word is proposed
_MOST = 3  # proposed words
_NUMBER = re.compile(r"-\.?\d")  # a value, not an option
_CAPTURE = ("", "the input is given without an option")
_RUN = ("--out", "use --out for what the command writes")
_SHORTER = ("--schedule-scale", "--schedule-scale 0.1 trains a tenth of the recipe's iterations")
_SMALLER = ("--downscale", "--downscale 2 halves the photographs")
_ELSEWHERE: dict[str, tuple[str, str]] = {  # option of other programs -> our option, advice
    **dict.fromkeys(("-s", "--source-path", "--data", "--data-dir", "--input", "-i"), _CAPTURE),
    **dict.fromkeys(("-m", "--model-path", "-o", "--output", "--output-dir", "--output-path", "--result-dir"), _RUN),
    **dict.fromkeys(("--iterations", "--iters", "--max-steps", "--num-iters", "--steps", "--total-steps"), _SHORTER),
    **dict.fromkeys(("-r", "--resolution", "--data-factor", "--images", "--downscale-factor"), _SMALLER),
    "--eval": ("--test-every", "--test-every 8 holds out every eighth photograph"),
}
_OUTPUTS = ("out", "video", "cache")  # paths that need not exist
_EXPECTED = {
    "RUN": "a run folder",
    "CAPTURE": "the folder of a capture",
    "PHOTOS": "a folder of photographs or a video",
    "DIR": "a folder",
    "FILE": "a file",
    "PATH": "a run folder, a capture or a file of splats, a mesh or points",
}


class UsageError(Exception):
    """A command line that does not parse; one line."""


class _Parser(argparse.ArgumentParser):
    """Parser of one command, without help."""

    def __init__(self, name: str) -> None:
        super().__init__(usage="", add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
        self._negative_number_matcher = _NUMBER  # as in Python 3.14; before, -1e-3 was an option
        options = options_of(NAMES[name])
        for option in options:
            if not option.mark.setting:
                option.add_to(self)
        if _has_settings(options) and not _trains(options):
            self.add_argument("--set", dest=_OVERRIDES, action="append")

    def error(self, message: str) -> NoReturn:
        raise UsageError(message.removeprefix("argument "))


def parse(argv: Sequence[str]) -> Common:
    """Return the command that the arguments ask for; ``argv`` has at least one word.

    Raises
    ------
    UsageError
        The arguments have a mistake.
    """
    name, *words = argv
    if name not in NAMES:
        raise UsageError(_with_help(_no_command(name, words), "gs2d --help"))
    try:
        command: Common = _made(NAMES[name], _given(name, _spelled(name, words)))
    except UsageError as error:
        raise UsageError(_with_help(str(error), f"gs2d {name} --help")) from None
    if isinstance(command, HowItRuns) and command.resume and command.overwrite:
        raise UsageError("--resume and --overwrite exclude each other; give one")
    return command


def _has_settings(options: Sequence[Option]) -> bool:
    return any(option.mark.setting for option in options)


def _trains(options: Sequence[Option]) -> bool:
    """Whether ``--set`` also changes the recipe."""
    return any(option.field == _OVERRIDES for option in options)


def _given(name: str, words: Sequence[str]) -> dict[str, Any]:
    """Return the values of a command line by field."""
    parsed, left = _Parser(name).parse_known_intermixed_args(words)
    options = options_of(NAMES[name])
    if unknown := next((word for word in left if _is_flag(word)), None):
        raise UsageError(_no_option(name, unknown.partition("=")[0], options))
    if left:
        arguments = " ".join(option.usage for option in options if option.positional)
        takes = f"{arguments} and options; a path with spaces needs quotes" if arguments else "options only"
        raise UsageError(f"unexpected {left[0]!r}: the command takes {takes}")
    given = {field: value for field, value in vars(parsed).items() if value not in (None, [])}
    given |= _settings(name, given.pop(_OVERRIDES, ()), options)
    if given.get("dry_run"):
        given.setdefault("out", Path("RUN"))  # nothing is written
    if missing := [option.usage for option in options if option.required and option.field not in given]:
        raise UsageError(f"gs2d {name} needs {' and '.join(missing)}")
    return given


def _made(kind: type, given: Mapping[str, Any]) -> Any:
    """Return a dataclass with the given values, which are also those of its nested dataclasses."""
    chosen = {}
    for field, hint, _ in fields_of(kind):
        if dataclasses.is_dataclass(hint):
            chosen[field.name] = _made(hint, given)
        elif field.name in given:
            value = given[field.name]
            chosen[field.name] = tuple(value) if isinstance(value, list) else value
    return kind(**chosen)


def _settings(name: str, changes: Sequence[str], options: Sequence[Option]) -> dict[str, Any]:
    """Return the values of ``--set`` by field: settings of the command, and changes of the recipe if it trains."""
    settings = {option.field: option for option in options if option.mark.setting}
    given: dict[str, Any] = {}
    for change in changes:
        word, _, text = change.partition("=")
        if word in settings:
            try:
                given[word] = settings[word].read(text)
            except ValueError as error:
                raise UsageError(str(error)) from None
        elif _trains(options):
            given.setdefault(_OVERRIDES, []).append(change)
        else:
            known = f"--set NAME=VALUE takes {', '.join(settings)}"
            raise UsageError(f"{known}; got {change!r}{_meant(word, settings)}")
    return given


def _spelled(name: str, words: Sequence[str]) -> list[str]:
    """Return the words with dashes for underscores in options (--max_size), and values of options that have none."""
    spelled = []
    bare = {option.name: option.mark.bare for option in options_of(NAMES[name]) if option.mark.bare}
    for word, following in itertools.zip_longest(words, words[1:], fillvalue=""):
        flag, equals, value = word.partition("=")
        flag = flag.replace("_", "-") if word.startswith("--") else flag
        if flag in bare and not equals and not following.isdecimal():
            equals, value = "=", bare[flag]
        spelled.append(flag + equals + value)
    return spelled


def _is_flag(word: str) -> bool:
    return word.startswith("-") and len(word) > 1 and not _NUMBER.match(word)


# -- paths -------------------------------------------------------------------------------------------------------------
def check_inputs(command: Common) -> None:
    """Raise for an input path that does not exist; cheap, so that a misspelt path is reported at once."""
    paths = dict(_inputs(command))
    kind: type = type(command)
    for option in options_of(kind):
        if (path := paths.get(option.field)) is None:
            continue
        try:
            path.stat()
        except (FileNotFoundError, NotADirectoryError):
            what = _EXPECTED.get(option.metavar, "a file or a folder")
            what += " or a file of splats" if (option.field, option.metavar) == ("path", "RUN") else ""
            raise UsageError(f"expected {what} at {path}, found nothing{where_it_ends(path)}") from None
        except (OSError, ValueError):
            continue  # reported by whatever reads it


def _inputs(options: Any) -> Iterator[tuple[str, Path]]:
    """Yield the paths that a command reads, by their fields."""
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            yield from _inputs(value)
        unneeded = field.name == "photos" and getattr(options, "resume", False)  # their cameras may be known
        if isinstance(value, Path) and field.name not in _OUTPUTS and not unneeded:
            yield field.name, value


# -- messages ----------------------------------------------------------------------------------------------------------
def _with_help(text: str, command: str) -> str:
    return f"{text} See `{command}`" if text.endswith("?") else f"{text}; see `{command}`"


def _no_command(name: str, words: Sequence[str]) -> str:
    """Return the message for a first word that is no command."""
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
    known = [word for option in options for word in option.flags]
    here, advice = _ELSEWHERE.get(flag, ("", ""))
    if here in known or (advice and not here):
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
    begun = sorted((other for other in known if other.startswith(flag)), key=len)[:_MOST]
    meant = f"; did you mean {_listed(begun, 'or')}?" if begun else _meant(flag, known)
    return f"gs2d {name} has no option {flag}{meant}"


def _meant(word: str, known: Iterable[str], before: str = "") -> str:
    """Return "; did you mean ...?" with the most similar names, or nothing."""
    plain = {name.lstrip("-"): name for name in known}
    close = [plain[name] for name in difflib.get_close_matches(word.lstrip("-"), list(plain), n=2, cutoff=_ALIKE)]
    names = [f"`{before}{name}`" if before else name for name in close]
    return f"; did you mean {_listed(names, 'or')}?" if names else ""


def _listed(names: Sequence[str], last: str) -> str:
    """Return "a, b or c"."""
    return f" {last} ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)
