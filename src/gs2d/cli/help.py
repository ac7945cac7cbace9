"""``--help`` prints the most used options, ``--help-all`` all. Neither imports torch, so both are instant."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from functools import partial

from gs2d.cli.command_line import NAMES, Option, about, options_of
from gs2d.cli.commands import COMMANDS, GROUPS, Common
from gs2d.pipeline.prepare.options import CommonTraining, HowItRuns, PoseEstimation, Training

_SLOGAN = "Turns photographs into a surface mesh and a 3D scene that you can view from any angle."
_OWN = "Of this command"
WIDEST = 100  # columns of help; longer lines are hard to read
TITLES = {  # headings of shared options, in order
    PoseEstimation: "Cameras of photographs",
    CommonTraining: "Training",
    Training: "Training",
    HowItRuns: "How it runs",
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
    parser = _parser("gs2d", "gs2d COMMAND [OPTIONS]", _SLOGAN, "Options: gs2d COMMAND --help; the version: --version")
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
