"""What commands and options there are, read from the dataclasses that tyro parses: for help and for did-you-mean.

tyro stays the parser. What it says of a mistake is a box of some twenty lines, and its help is one list of all options;
here is what both are written anew from. A test compares this with what tyro accepts.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import textwrap
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

_POSITIONAL = get_args(tyro.conf.Positional[int])[1]
_APPEND = get_args(tyro.conf.UseAppendAction[int])[1]
_NO_PREFIX = get_args(tyro.conf.OmitArgPrefixes[int])[1]
_FIXED = get_args(tyro.conf.Fixed[int])[1]
_NAMES = {int: "N", float: "NUMBER", Path: "PATH", str: "NAME"}  # what stands for a value in help
_MANY = 24  # columns of choices, from which they are listed in the text and not before it


@dataclass(frozen=True)
class Option:
    """An option or a positional argument of a command.

    Attributes
    ----------
    field : str
        Name of the dataclass field.
    flags : tuple of str
        As it is written, ``--out``; empty for a positional argument.
    kind : type
        bool for a switch, else the type of each value.
    choices : tuple of str
        The only values there are; empty: any.
    count : int or None
        How many words it takes; None: any number.
    metavar : str
        What stands for a value in help.
    required : bool
    default : object
    about : str
        Its docstring, in one line.
    group : type
        The dataclass that defines it.
    """

    field: str
    flags: tuple[str, ...]
    kind: type
    choices: tuple[str, ...]
    count: int | None
    metavar: str
    required: bool
    default: Any
    about: str
    group: type

    @property
    def name(self) -> str:
        """Return what it is called in a sentence."""
        return self.flags[0] if self.flags else self.metavar

    @property
    def usage(self) -> str:
        """Return how it is written, with its value."""
        value = f"{self.count} {self.metavar}S" if (self.count or 0) > 1 and " " not in self.metavar else self.metavar
        value += " ..." if self.count is None and "..." not in value else ""
        return " ".join(word for word in (self.name if self.flags else "", "" if self.kind is bool else value) if word)


def about(kind: type) -> str:
    """Return the docstring of a command in one line."""
    return " ".join((kind.__doc__ or "").split())


@functools.cache
def options_of(kind: type) -> tuple[Option, ...]:
    """Return the options of a command, those of its groups included, in the order of the dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    found: list[Option] = []
    for field in dataclasses.fields(kind):
        inner, marks = _unwrapped(hints[field.name])
        if _NO_PREFIX in marks:
            found += options_of(inner)
        elif _FIXED not in marks:  # of Python only
            found.append(_option(kind, field, inner, marks))
    return tuple(found)


def _option(kind: type, field: dataclasses.Field[Any], inner: Any, marks: tuple[Any, ...]) -> Option:
    settings = next((mark for mark in marks if hasattr(mark, "metavar")), None)  # what `tyro.conf.arg` made
    name = (settings and settings.name) or field.name
    parsed = settings and settings.constructor_factory  # as what tyro reads it, where that is not its type
    value, choices, count = _value(parsed() if parsed else inner)
    switched_off = "no-" if value is bool and field.default is True else ""  # what is on is switched off
    written = "--" + switched_off + name.replace("_", "-")
    flags = () if _POSITIONAL in marks else (written, *((settings and settings.aliases) or ()))
    owner = next(base for base in kind.__mro__ if field.name in vars(base).get("__annotations__", {}))
    metavar = (settings and settings.metavar) or _metavar(name, value, choices, positional=not flags)
    return Option(
        field=field.name,
        flags=flags,
        kind=value,
        choices=choices,
        count=1 if _APPEND in marks else count,
        metavar=metavar,
        required=field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING,
        default=None if field.default is dataclasses.MISSING else field.default,
        about=_docstrings(owner).get(field.name, ""),
        group=owner,
    )


def _metavar(name: str, value: type, choices: tuple[str, ...], *, positional: bool) -> str:
    """Return what stands for a value: the values themselves, if they are few."""
    if not choices:
        return _NAMES.get(value, "VALUE")
    listed = "|".join(choices)
    return name.split("_")[-1].upper() if positional or len(listed) > _MANY else listed


def _unwrapped(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return a type without its annotations, and these."""
    marks: tuple[Any, ...] = ()
    while get_origin(hint) is Annotated:
        hint, *more = get_args(hint)
        marks += tuple(more)
    return hint, marks


def _value(hint: Any) -> tuple[type, tuple[str, ...], int | None]:
    """Return the type of a value, the values there are, and how many are taken."""
    hint, _ = _unwrapped(hint)
    if get_origin(hint) in (Union, types.UnionType):
        return _value(next(part for part in get_args(hint) if part is not type(None)))
    if get_origin(hint) is Literal:
        return str, tuple(map(str, get_args(hint))), 1
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        value, choices, _ = _value(parts[0])
        return value, choices, None if parts[-1] is Ellipsis else len(parts)
    return hint, (), 0 if hint is bool else 1


@functools.cache
def _docstrings(kind: type) -> dict[str, str]:
    """Return the strings below the fields of a dataclass."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for field, text in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            found[field.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
    return found
