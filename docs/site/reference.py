"""The generated pages: commands from the options that the program parses, Python from the public face's docstrings."""

from __future__ import annotations

import inspect
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator

import gs2d
from gs2d.cli.command_line import NAMES, TITLES, Option, about, groups, option_text, options_of

_SPOKEN = re.compile(r"(`[^`]*`)")  # what is code already


def commands() -> str:
    """Return every command with every option, as Markdown; options of several commands once, at the end."""
    owners: dict[type, list[str]] = defaultdict(list)
    for name in _names():
        for group in {option.owner for option in options_of(NAMES[name])}:
            owners[group].append(name)
    shared = {group for group, names in owners.items() if len(names) > 1}
    lines = []
    for title, names in groups().items():
        lines += [f"## {title}", ""]
        for name in names:
            lines += _command(name, shared)
    lines += ["## Options of several commands", ""]
    for group in sorted(shared, key=lambda group: -len(owners[group])):
        used = ", ".join(f"[`{name}`](#gs2d-{name})" for name in owners[group])
        lines += [f"### {_heading(group)}", "", f"Options of {used}.", ""]
        options = {option.field: option for name in owners[group] for option in options_of(NAMES[name])}
        lines += _explained([option for option in options.values() if option.owner is group])
    return "\n".join(lines)


def _names() -> Iterator[str]:
    for names in groups().values():
        yield from names


def _command(name: str, shared: set[type]) -> list[str]:
    """Return a command: how it is called, what it does, its own options, and where the others are."""
    options = options_of(NAMES[name])
    needed = sorted((o for o in options if o.required or o.mark.positional), key=lambda o: not o.mark.positional)
    usage = " ".join(o.usage if o.required else f"[{o.usage}]" for o in needed)
    lines = [f"### gs2d {name}", "", "```text", f"gs2d {name} {usage} [OPTIONS]".replace("  ", " "), "```", ""]
    lines += [_plain(about(NAMES[name])), "", *_explained(_arguments_first(options, shared))]
    others = list(dict.fromkeys(o.owner for o in options if o.owner in shared))
    if others:
        links = ", ".join(f"[{_heading(group)}](#{_anchor(_heading(group))})" for group in others)
        lines += [f"Also: {links}.", ""]
    return lines


def _arguments_first(options: Iterable[Option], shared: set[type]) -> list[Option]:
    """Return a command's own options, what stands alone on a command line before what has a name."""
    return sorted((o for o in options if o.owner not in shared), key=lambda o: not o.mark.positional)


def _explained(options: list[Option]) -> list[str]:
    lines = []
    for option in options:
        lines += [f"`{option.usage}`", f": {_plain(option_text(option))}", ""]
    return lines


def _heading(group: type) -> str:
    """Return what a group of options is called."""
    return TITLES.get(group) or re.sub(r"(?<=[a-z])(?=[A-Z])", " ", group.__name__).capitalize()


def _anchor(heading: str) -> str:
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def _plain(text: str) -> str:
    """Return text in which only what is in backticks is marked up."""
    pieces = _SPOKEN.split(text)
    return "".join(p if p.startswith("`") else re.sub(r"([*_<>\[\]{}|\\$])", r"\\\1", p) for p in pieces)


def python() -> str:
    """Return the public face as directives for Sphinx's autodoc: functions first, then types."""
    names = [name for name in gs2d.__all__ if name != "__version__"]
    kinds = {
        "Functions": [name for name in names if not inspect.isclass(getattr(gs2d, name))],
        "Types": [name for name in names if inspect.isclass(getattr(gs2d, name))],
    }
    lines = []
    for title, found in kinds.items():
        lines += [f"## {title}", ""]
        for name in found:
            kind = "autofunction" if title == "Functions" else "autoclass"
            members = ["   :members:"] if kind == "autoclass" else []
            fields = getattr(getattr(gs2d, name), "_fields", ())  # of a named tuple: its docstring has them
            members += [f"   :exclude-members: {', '.join(fields)}"] if fields else []
            lines += [f"### {name}", "", "```{eval-rst}", f".. {kind}:: gs2d.{name}", *members, "```", ""]
    return "\n".join(lines)
