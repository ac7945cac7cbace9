"""The commands of ``gs2d`` by name: of the core, of contrib and of installed packages."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gs2d.config.registry import Register, Registry

BEGIN = "To begin with"
STEPS = "Step by step"
LOOK = "Look, keep and share"
MEASURE = "Measure and compare"
GROUPS = (BEGIN, STEPS, LOOK, MEASURE)  # the order of the help; other groups follow


@dataclass(frozen=True)
class Command:
    """A command of ``gs2d``.

    Attributes
    ----------
    name : str
    options : type
        A dataclass of ``gs2d.cli.commands.Common``; its docstring and those of its fields are the help.
    action : str
        "module:function"; called with the parsed options and a ``gs2d.cli.console.Console``. The module is imported
        when the command runs.
    group : str
        Heading in ``gs2d --help``.
    first : tuple of str
        Fields that ``gs2d COMMAND --help`` explains, the most used first; (): all of this command alone.
    """

    name: str
    options: type
    action: str
    group: str
    first: tuple[str, ...] = ()

    def run(self, options: Any, console: Any) -> None:
        """Run the command."""
        module, _, function = self.action.partition(":")
        getattr(importlib.import_module(module), function)(options, console)


_CORE = (
    *("doctor", "reconstruct", "view", "poses", "train", "mesh"),
    *("info", "render", "export", "edit", "evaluate", "recipes"),
)
COMMANDS: Registry[Command] = Registry("command", "gs2d.commands", builtin=dict.fromkeys(_CORE, "gs2d.cli.commands"))


def register_command(
    name: str, *, action: str, group: str, first: tuple[str, ...] = ()
) -> Callable[[Register], Register]:
    """Return a decorator that registers a command of ``gs2d``.

    Parameters
    ----------
    name : str
        Name on the command line; must be unused.
    action : str
        "module:function" that runs the command, called with the options and the console. The module is imported when
        the command runs. The module of the options should import neither torch nor NumPy, so that help stays fast.
    group : str
        Heading in ``gs2d --help``, such as "Measure and compare".
    first : tuple of str
        Fields that ``gs2d COMMAND --help`` explains, the most used first; (): all of this command alone.

    Returns
    -------
    callable
        Decorates a frozen dataclass of ``gs2d.cli.commands.Common``, whose fields are the options.
    """

    def registered(options: Register) -> Register:
        kind: Any = options
        COMMANDS.register(name, module=kind.__module__)(Command(name, kind, action, group, first))
        return options

    return registered
