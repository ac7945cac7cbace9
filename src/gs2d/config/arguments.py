"""Marks for fields of options classes: how they are written on the command line where name and type do not say it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Arg:
    """How a field is written on the command line, in ``Annotated``."""

    name: str = ""  # name of the option if it differs from the field's: "set" for ``--set``
    metavar: str = ""  # word for the value in help; empty: by the type
    kind: type | None = None  # type that a word is converted to; None: that of the field
    bare: str = ""  # value of the option if none follows it, where values are numbers; empty: a value must follow
    positional: bool = False  # written without a name
    repeated: bool = False  # one value for each time the option is given
    setting: bool = False  # rarely needed: written as ``--set NAME=VALUE``
    python_only: bool = False  # not on the command line


PYTHON_ONLY = Arg(python_only=True)
SETTING = Arg(setting=True)
