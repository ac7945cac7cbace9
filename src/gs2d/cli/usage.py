"""Mistakes on a command line, in one line each with what was probably meant. What is in order goes to tyro."""

from __future__ import annotations

import dataclasses
import difflib
import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from gs2d.cli.catalogue import Option, options_of
from gs2d.cli.commands import COMMANDS, Common
from gs2d.core.missing import where_it_ends

NAMES: dict[str, type] = {command.__name__.lower(): command for command in COMMANDS}
HELP_WORDS = ("-h", "--help", "--help-all")
_NUMBER = re.compile(r"-\.?\d")  # a value, not an option
_ALIKE = 0.6  # of difflib's ratio, from which a word is proposed
_MOST = 3  # words that are proposed
_CAPTURE = ("", "what is read stands alone, without an option")
_RUN = ("--out", "what is made goes to --out")
_SHORTER = ("--schedule-scale", "--schedule-scale 0.1 trains a tenth of the recipe's iterations")
_SMALLER = ("--downscale", "--downscale 2 halves the photographs")
_ELSEWHERE: dict[str, tuple[str, str]] = {  # what other programs of the field call it -> our option, what is said
    **dict.fromkeys(("-s", "--source-path", "--data", "--data-dir", "--input", "-i"), _CAPTURE),
    **dict.fromkeys(("-m", "--model-path", "-o", "--output", "--output-dir", "--output-path", "--result-dir"), _RUN),
    **dict.fromkeys(("--iterations", "--iters", "--max-steps", "--num-iters", "--steps", "--total-steps"), _SHORTER),
    **dict.fromkeys(("-r", "--resolution", "--data-factor", "--images", "--downscale-factor"), _SMALLER),
    "--eval": ("--test-every", "--test-every 8 holds every eighth photograph out"),
}


_OUTPUTS = ("out", "video", "cache")  # paths that need not exist
_EXPECTED = {
    "RUN": "a run folder",
    "SCENE": "the folder of a capture",
    "CAPTURE": "the folder of a capture",
    "PHOTOS": "a folder of photographs or a video",
    "DIR": "a folder",
    "FILE": "a file",
    "PATH": "a run folder, a capture or a file of splats, a mesh or points",
}


class UsageError(Exception):
    """A command line that does not parse; one line."""


def check(argv: Sequence[str]) -> None:
    """Raise for a command line with a mistake that can be explained; ``argv`` has at least one word."""
    name, words = argv[0], argv[1:]
    if name not in NAMES:
        raise UsageError(_with_help(_no_command(name, words), "gs2d --help"))
    try:
        _check_words(name, words)
    except UsageError as error:
        raise UsageError(_with_help(str(error), f"gs2d {name} --help")) from None


def check_inputs(command: Common) -> None:
    """Raise for a path to read that leads nowhere; cheap, so that a misspelt path is reported at once."""
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


def _with_help(text: str, command: str) -> str:
    return f"{text} See `{command}`" if text.endswith("?") else f"{text}; see `{command}`"


def _no_command(name: str, words: Sequence[str]) -> str:
    """Return what is said of a first word that is no command."""
    if name.startswith("-"):
        command = next((word for word in words if word in NAMES), None)
        if command is not None:
            rest = [word for word in words if word != command]
            return f"options come after the command: gs2d {shlex.join([command, name, *rest])}"
        return f"no option {name}{_meant(name, ('--help', '--help-all', '--version'))}"
    if name.lower() not in NAMES and Path(name).exists():
        return f"{name} is not a command; did you mean `gs2d reconstruct {shlex.quote(name)} --out RUN`?"
    return f"no command {name!r}{_meant(name.lower(), NAMES, 'gs2d ')}"


def _check_words(name: str, words: Sequence[str]) -> None:
    """Walk through the words as the parser does."""
    options = options_of(NAMES[name])
    flags = {flag: option for option in options for flag in option.flags}
    seen: set[str] = set()
    loose: list[int] = []  # of words
    i = 0
    while i < len(words):
        word, i = words[i], i + 1
        if not _is_flag(word):
            loose.append(i - 1)
            continue
        flag, equals, value = word.partition("=")
        option = flags.get(flag.replace("_", "-"))
        if option is None:
            raise UsageError(_no_option(name, flag, flags))
        values = [value] if equals else []
        while not equals and i < len(words) and not _is_flag(words[i]) and option.count != len(values):
            values, i = [*values, words[i]], i + 1
        _check_values(option, values, given=bool(equals))
        seen.add(option.field)
    _check_positional([option for option in options if not option.flags], words, loose, seen)
    if lacking := [option.usage for option in options if option.required and option.field not in seen]:
        raise UsageError(f"gs2d {name} needs {' and '.join(lacking)}")


def _is_flag(word: str) -> bool:
    return word.startswith("-") and len(word) > 1 and not _NUMBER.match(word)


def _no_option(name: str, flag: str, flags: Iterable[str]) -> str:
    """Return what is said of an option that the command does not have: one much like it, or a command that does."""
    known = list(flags)
    wanted = flag.replace("_", "-")
    here, said = _ELSEWHERE.get(wanted, ("", ""))
    if here in known or (said and not here):
        return f"gs2d {name} has no option {flag}; {said}"
    others = [
        other
        for other, command in NAMES.items()
        if other != name and any(wanted in option.flags for option in options_of(command))
    ]
    if others:
        have = ("has" if len(others) == 1 else "have") + " one"
        return f"gs2d {name} has no option {flag}; {_listed([f'gs2d {other}' for other in others], 'and')} {have}"
    begun = sorted((other for other in known if other.startswith(wanted)), key=len)[:_MOST]
    meant = f"; did you mean {_listed(begun, 'or')}?" if begun else _meant(wanted, known)
    return f"gs2d {name} has no option {flag}{meant}"


def _check_values(option: Option, values: Sequence[str], *, given: bool) -> None:
    """Raise for values of an option or a positional argument that it does not take."""
    if option.count == 0:
        if given:
            raise UsageError(f"{option.name} takes no value, got {values[0]!r}")
        return
    if option.count is not None and len(values) < option.count:
        many = f"{option.count} numbers, got {len(values)}" if option.count > 1 else f"a value: {option.usage}"
        raise UsageError(f"{option.name} needs {many}")
    for value in values:
        if option.choices and value not in option.choices and not _is_default(option, value):
            meant = _meant(value, option.choices)
            raise UsageError(f"{option.name} must be {_listed(option.choices, 'or')}, got {value!r}{meant}")
        if option.kind in (int, float) and not _is_default(option, value) and not _converts(option.kind, value):
            what = "a whole number" if option.kind is int else "a number"
            raise UsageError(f"{option.name} must be {what}, got {value!r}")


def _is_default(option: Option, value: str) -> bool:
    """Whether a value is tyro's word for a default that is no value."""
    return value == "None" and option.default is None


def _converts(kind: type, value: str) -> bool:
    try:
        kind(value)
    except ValueError:
        return False
    return True


def _check_positional(options: Sequence[Option], words: Sequence[str], loose: Sequence[int], seen: set[str]) -> None:
    """Give the words without an option, of these indices, to the arguments in their order."""
    left = list(loose)
    for option in options:
        taken, left = (left, []) if option.count is None else (left[:1], left[1:])
        if taken:
            _check_values(option, [words[i] for i in taken], given=False)
            seen.add(option.field)
    if left:
        takes = f"takes {' '.join(option.usage for option in options)} and options" if options else "takes options only"
        raise UsageError(f"what is {words[left[0]]!r}? The command {takes}{_quotes(words, left[0])}")


def _quotes(words: Sequence[str], index: int) -> str:
    """Return what is to be said of a word too many that may be a part of a path with spaces."""
    first = last = index
    while first > 0 and not _is_flag(words[first - 1]):
        first -= 1
    while last + 1 < len(words) and not _is_flag(words[last + 1]):
        last += 1
    if first == last:
        return ""
    for start in range(first, index + 1):
        for end in range(last, max(index, start + 1) - 1, -1):
            if Path(whole := " ".join(words[start : end + 1])).exists():
                return f"; a path with spaces needs quotes: {shlex.quote(whole)}"
    return "; a path with spaces needs quotes"


def _meant(word: str, known: Iterable[str], before: str = "") -> str:
    """Return "; did you mean ...?" with the names most like a word, or nothing."""
    plain = {name.lstrip("-"): name for name in known}
    close = [plain[name] for name in difflib.get_close_matches(word.lstrip("-"), list(plain), n=2, cutoff=_ALIKE)]
    names = [f"`{before}{name}`" if before else name for name in close]
    return f"; did you mean {_listed(names, 'or')}?" if names else ""


def _listed(names: Sequence[str], last: str) -> str:
    """Return "a, b or c"."""
    return f" {last} ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)
