"""The options of each command, read from its dataclass: for the parser, the reference page, and ``--help``.

``--help`` prints the most used options, ``--help-all`` all. Neither imports torch, so both are instant.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import functools
import inspect
import itertools
import shutil
import sys
import types
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from gs2d.cli.commands import COMMANDS, GROUPS, Common
from gs2d.config.arguments import Arg
from gs2d.pipeline.prepare.options import CommonTraining, HowItRuns, PoseEstimation, Training

NAMES: dict[str, type] = {name: command.options for name, command in COMMANDS.working()}
_METAVARS = {int: "N", float: "NUMBER", Path: "PATH", str: "NAME"}
_SWITCH = {"true": True, "false": False}
_MANY = 24  # columns; longer lists of choices are in the text of the option


@dataclass(frozen=True)
class Option:
    """An option, a setting or a positional argument of a command."""

    field: str  # name of the dataclass field
    flags: tuple[str, ...]  # names on the command line, `--out`; empty for a setting and a positional argument
    mark: Arg
    kind: type  # bool for a switch, else the type of each value
    choices: tuple[str, ...]  # the valid values; empty: any
    count: int | None  # number of values; None: one or more
    metavar: str  # word for a value in help
    default: Any  # `dataclasses.MISSING` if a value is required
    about: str  # docstring of the field, in one line
    owner: type  # the dataclass that defines the field

    @property
    def required(self) -> bool:
        """Return whether the command needs a value."""
        return self.default is dataclasses.MISSING

    @property
    def name(self) -> str:
        """Return the name for messages."""
        return self.flags[0] if self.flags else f"--set {self.field}" if self.mark.setting else self.metavar

    @property
    def usage(self) -> str:
        """Return the option with its value, as it is written."""
        value = f"{self.count} {self.metavar}S" if (self.count or 0) > 1 and " " not in self.metavar else self.metavar
        value += " ..." if self.count is None and "..." not in value else ""
        if self.mark.setting:
            return f"{self.name}={value}"
        value = "" if self.kind is bool else value
        return " ".join(word for word in ("" if self.mark.positional else self.name, value) if word)

    def add_to(self, parser: argparse._ActionsContainer, text: str = "") -> None:
        """Add the option to a parser with its help text; no option is required there. Settings are for help only."""
        text = text.replace("%", "%%")
        if self.mark.setting:
            parser.add_argument(self.field, metavar=self.usage, help=text)
            return
        if self.kind is bool:
            action = "store_false" if self.default else "store_true"
            parser.add_argument(*self.flags, dest=self.field, action=action, help=text)
            return
        nargs: int | str | None = "+" if self.count is None else self.count if self.count > 1 else None
        if self.mark.positional:
            nargs = "*" if self.count is None else "?"
        parser.add_argument(
            *(self.flags or (self.field,)),
            **({"dest": self.field} if self.flags else {"default": None}),
            action="append" if self.mark.repeated else "store",
            nargs=nargs,
            type=self.kind,
            choices=self.choices or None,
            help=text,
            metavar=tuple(self.metavar.split()) if isinstance(nargs, int) else self.metavar,
        )

    def read(self, text: str) -> Any:
        """Return the value of a setting. Raises ValueError, with the valid values, if the text is invalid."""
        words = text.split(",") if self.count != 1 else [text]
        try:
            values = tuple(_SWITCH[word] if self.kind is bool else self.kind(word) for word in words)
        except (KeyError, ValueError):
            values = ()
        if len(values) != (self.count or len(words)) or not set(values) <= set(self.choices or values):
            raise ValueError(f"{self.usage} expected, got {text!r}")
        return values if self.count != 1 else values[0]


def about(kind: type) -> str:
    """Return the docstring of a command in one line."""
    return " ".join((kind.__doc__ or "").split())


@functools.cache
def options_of(kind: type) -> tuple[Option, ...]:
    """Return the options of a command, in the order of the fields."""
    hints = get_type_hints(kind, include_extras=True)
    options = []
    for field in dataclasses.fields(kind):
        hint, mark = hints[field.name], Arg()
        if get_origin(hint) is Annotated:
            hint, mark = get_args(hint)
        if not mark.python_only:
            options.append(_option(kind, field, hint, mark))
    return tuple(options)


def _option(kind: type, field: dataclasses.Field[Any], hint: Any, mark: Arg) -> Option:
    value, choices, count = _value(hint)
    name = mark.name or field.name
    switched_off = "no-" if value is bool and field.default is True else ""
    listed = "true|false" if value is bool else "|".join(choices)
    if choices and not mark.setting and (mark.positional or len(listed) > _MANY):
        listed = name.split("_")[-1].upper()
    owner = next(base for base in kind.__mro__ if field.name in vars(base).get("__annotations__", {}))
    return Option(
        field=field.name,
        flags=() if mark.positional or mark.setting else ("--" + switched_off + name.replace("_", "-"),),
        mark=mark,
        kind=mark.kind or value,
        choices=choices,
        count=1 if mark.repeated else count,
        metavar=mark.metavar or listed or _METAVARS.get(value, "VALUE"),
        default=field.default,
        about=_docstrings(owner).get(field.name, ""),
        owner=owner,
    )


def _value(hint: Any) -> tuple[type, tuple[str, ...], int | None]:
    """Return the type of a value, the choices, and the number of values; of a union the first type."""
    if get_origin(hint) in (Union, types.UnionType):
        return _value(get_args(hint)[0])
    if get_origin(hint) is Literal:
        return str, get_args(hint), 1
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        return *_value(parts[0])[:2], None if parts[-1] is Ellipsis else len(parts)
    return hint, (), 1


@functools.cache
def _docstrings(kind: type) -> dict[str, str]:
    """Return the strings below the fields of a dataclass, each in one line."""
    texts = {}
    body = _classes(kind.__module__)[kind.__name__].body
    for field, text in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            texts[field.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
    return texts


@functools.cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    """Return the classes of a module as syntax trees. ``inspect.getsource`` would parse the module for each class."""
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


# -- help --------------------------------------------------------------------------------------------------------------
_SLOGAN = "Turns photographs into a surface mesh and a 3D scene that you can view from any angle."
_OWN = "More options"
WIDEST = 100  # columns of help; longer lines are hard to read
TITLES = {  # headings of shared options, in order
    PoseEstimation: "Cameras of photographs",
    CommonTraining: "Training",
    Training: "Viewer and cache",
    HowItRuns: "Execution",
    Common: "Output",
}


def groups() -> dict[str, list[str]]:
    """Return the names of all commands by heading."""
    by_title: dict[str, list[str]] = {title: [] for title in GROUPS}
    for name in NAMES:
        by_title.setdefault(COMMANDS[name].group, []).append(name)
    return {title: names for title, names in by_title.items() if names}


def program_help(*, everything: bool = False) -> list[str]:
    """Return all commands in groups; with ``everything`` also all options of each."""
    parser = _parser("gs2d", "gs2d COMMAND [OPTIONS]", _SLOGAN, "Options: gs2d COMMAND --help. Version: gs2d --version")
    for title, names in groups().items():
        group = parser.add_argument_group(title)
        for name in names:
            group.add_argument(name, help=about(NAMES[name]))
    lines = parser.format_help().splitlines()
    for name in [name for names in groups().values() for name in names] if everything else ():
        lines += ["", *command_help(name, everything=True)]
    return lines


def command_help(name: str, *, everything: bool = False) -> list[str]:
    """Return the help of a command: its most used options and the number of the others, or all options in groups."""
    options = options_of(NAMES[name])
    needed = sorted((o for o in options if o.required or o.mark.positional), key=lambda o: not o.mark.positional)
    words = [o.usage if o.required else f"[{o.usage}]" for o in needed]
    titled = _groups(name, options)
    more = sum(len(group) for title, group in titled.items() if title)
    rest = "" if everything else f"{more} more options: --help-all"
    parser = _parser(f"gs2d {name}", " ".join([f"gs2d {name}", *words, "[OPTIONS]"]), about(NAMES[name]), rest)
    for title, group in titled.items():
        if everything or not title:
            shown = parser.add_argument_group(title or None)
            for option in group:
                option.add_to(shown, option_text(option))
    return parser.format_help().splitlines()


def _parser(prog: str, usage: str, description: str, epilog: str) -> argparse.ArgumentParser:
    width = max(20, min(shutil.get_terminal_size().columns, WIDEST))
    formatter = partial(argparse.HelpFormatter, max_help_position=28, width=width)
    return argparse.ArgumentParser(
        prog, usage, description, epilog, formatter_class=formatter, add_help=False, allow_abbrev=False
    )


def _groups(name: str, options: Sequence[Option]) -> dict[str, list[Option]]:
    """Return all options by heading: the most used under "", then those of the command, then shared options."""
    by_field = {option.field: option for option in options}
    own = sorted((o for o in options if o.owner is not Common), key=lambda o: (not o.mark.positional, not o.required))
    first = [by_field[field] for field in COMMANDS[name].first] or own
    groups: dict[str, list[Option]] = {title: [] for title in ("", _OWN, *TITLES.values())}
    groups[""] = first
    for option in options:
        if option not in first:
            groups[TITLES.get(option.owner, _OWN)].append(option)
    return {title: sorted(group, key=lambda o: o.mark.setting) for title, group in groups.items() if group}


def option_text(option: Option) -> str:
    """Return the help of an option: its docstring, choices that its metavar does not list, and the default."""
    values = "" if all(choice in option.usage for choice in option.choices) else f" {', '.join(option.choices)}."
    no_default = option.kind is bool or option.required or option.default in (None, (), "")
    stated = "default:" in option.about or no_default
    return option.about + values + ("" if stated else f" (default: {_shown(option.default)})")


def _shown(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
