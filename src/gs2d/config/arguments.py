"""Marks for fields of options classes: how they are written on the command line where name and type do not say it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Arg:
    """How a field is written on the command line, in ``Annotated``.

    Attributes
    ----------
    name : str
        Name of the option if it differs from the field's: "set" for ``--set``.
    metavar : str
        Word for the value in help; empty: by the type.
    kind : type or None
        Type that a word is converted to; None: that of the field.
    bare : str
        Value of the option if none follows it, where values are numbers; empty: a value must follow.
    positional : bool
        Written without a name.
    repeated : bool
        One value for each time the option is given.
    setting : bool
        Rarely needed: written as ``--set NAME=VALUE``.
    python_only : bool
        Not on the command line.
    """

    name: str = ""
    metavar: str = ""
    kind: type | None = None
    bare: str = ""
    positional: bool = False
    repeated: bool = False
    setting: bool = False
    python_only: bool = False


PYTHON_ONLY = Arg(python_only=True)
SETTING = Arg(setting=True)
