"""The extension points of gs2d: named objects, registered by gs2d, by programs and by installed packages.

Each kind (loss, reader of captures, command, ...) is one :class:`Registry`. A decorator registers an object; an
installed package names it as an entry point. ``gs2d.contrib`` is registered by the entry points of gs2d itself. Pure
Python; never imports torch.
"""

from __future__ import annotations

import difflib
import functools
import tomllib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, distributions, entry_points
from pathlib import Path
from typing import Any, Generic, TypeVar

from gs2d.errors import Gs2dError, PluginWarning

__all__ = ["Register", "Registry", "absent_guests", "did_you_mean"]

T = TypeVar("T")
Register = TypeVar("Register")
_ABSENT = ContextVar("absent guests", default=False)
_PACKAGE = Path(__file__).resolve().parents[1]
_DISTRIBUTION, _CONTRIB = "2dgs-r", "gs2d.contrib."


@contextmanager
def absent_guests() -> Iterator[None]:
    """Accept names that nothing has: the recipe of a finished run may name what is no longer installed."""
    token = _ABSENT.set(True)
    try:
        yield
    finally:
        _ABSENT.reset(token)


class Registry(Generic[T]):
    """What can be asked for by name: what gs2d has, what programs register, and what installed packages offer.

    Nothing is imported before it is asked for; a package that cannot be imported is told in one line, and stops only
    those who ask for what it offers.

    Parameters
    ----------
    what : str
        One of the things, in words: "loss".
    group : str
        Entry points of packages that offer them: "gs2d.losses".
    builtin : mapping of name to module
        What gs2d itself has; the module registers it when it is imported.
    error : type of Gs2dError
        What a wrong name raises.
    """

    def __init__(
        self,
        what: str,
        group: str,
        *,
        builtin: Mapping[str, str] | None = None,
        error: type[Gs2dError] = Gs2dError,
    ) -> None:
        self.what, self.group, self._error = what, group, error
        self._core = {} if builtin is None else dict(builtin)
        self._things: dict[str, T] = {}

    @cached_property
    def _homes(self) -> dict[str, str]:
        """Modules of gs2d that register a name when they are imported: those of the core, then those of contrib."""
        return self._core | {entry.name: entry.module for entry in contrib_entries() if entry.group == self.group}

    def register(self, name: str, *, module: str | None = None) -> Callable[[Register], Register]:
        """Return a decorator that registers an object under a name.

        ``module`` is where the object is defined, if its ``__module__`` does not say so.

        Raises
        ------
        Gs2dError
            From the decorator: the name is taken.
        """

        def registered(thing: Register) -> Register:
            home = module or getattr(thing, "__module__", "")
            if self._homes.get(name, home) != home:
                raise self._error(f"{self.what} {name!r} is one of gs2d's own; give yours another name")
            holder = self._things.get(name)
            if holder is not None and holder is not thing:
                raise self._error(
                    f"{self.what} {name!r} is registered already, by {getattr(holder, '__module__', 'another')}; give "
                    "yours another name"
                )
            self._things[name] = thing  # type: ignore[assignment]
            return thing

        return registered

    def get(self, name: str) -> T:
        """Return the thing of this name, imported now if it was not before.

        Raises
        ------
        Gs2dError
            There is none of this name, or its package cannot be imported.
        """
        if name in self._homes and name not in self._things:
            import_module(self._homes[name])
        if name in self._things:
            return self._things[name]
        if name in self._offered:
            return self._load(name)
        raise self._error(self.unknown(name))

    def __getitem__(self, name: str) -> T:
        return self.get(name)

    def unknown(self, name: str, *, also: Sequence[str] = ()) -> str:
        """Return the line about a name that stands for nothing; ``also``: what can be said beside the names."""
        names = (*also, *self.names())
        return f"{self.what} must be one of {', '.join(names)}, got {name!r}{did_you_mean(name, names)}"

    def check(self, name: object) -> None:
        """Raise for a name that a recipe gives and nothing has, unless :func:`absent_guests` allows it.

        Nothing is imported. Names of this program must be registered before a recipe gives them.

        Raises
        ------
        Gs2dError
            Lists the names, and the nearest of them.
        """
        if name not in self and not _ABSENT.get():
            text = self.unknown(str(name))
            raise self._error(text if text.endswith("?") else f"{text}; gs2d.register_{self.what} adds one")

    @property
    def builtin(self) -> tuple[str, ...]:
        """The names of what gs2d itself has."""
        return tuple(self._homes)

    def names(self) -> tuple[str, ...]:
        """All names: gs2d's own, those of this program, those of packages."""
        return tuple(dict.fromkeys((*self._homes, *self._things, *self._offered)))

    def guests(self) -> tuple[str, ...]:
        """Return the names that are not gs2d's own."""
        return tuple(name for name in self.names() if name not in self._homes)

    def working(self, names: Sequence[str] | None = None) -> Iterator[tuple[str, T]]:
        """Yield names (default: all) with their objects; one that cannot be imported is a PluginWarning instead."""
        for name in self.names() if names is None else names:
            try:
                yield name, self.get(name)
            except Gs2dError as error:
                if name in self._homes:
                    raise
                warnings.warn(str(error), PluginWarning, stacklevel=2)

    def source(self, name: str) -> str:
        """Where a thing is from, in words: "gs2d", a package with its version, or a module of this program."""
        if name in self._homes:
            return "gs2d"
        if name in self._offered:
            return _package(self._offered[name])
        return str(getattr(self._things.get(name), "__module__", "this program"))

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and (name in self._homes or name in self._things or name in self._offered)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())

    def __len__(self) -> int:
        return len(self.names())

    @cached_property
    def _offered(self) -> dict[str, EntryPoint]:
        """Entry points of installed packages by name; of a name that is taken the first package keeps it."""
        offered: dict[str, EntryPoint] = {}
        guests = [entry for entry in entry_points(group=self.group) if not entry.value.startswith(_CONTRIB)]
        for entry in sorted(guests, key=_package):
            taken = "gs2d" if entry.name in self._homes else None
            if entry.name in offered and offered[entry.name].value != entry.value:
                taken = _package(offered[entry.name])
            if taken is None:
                offered[entry.name] = entry
            else:
                text = f"{_package(entry)} offers the {self.what} {entry.name!r}, which {taken} has; it is left out"
                warnings.warn(text, PluginWarning, stacklevel=3)
        return offered

    def _load(self, name: str) -> T:
        entry = self._offered[name]
        try:
            thing: Any = entry.load()
        except Exception as error:  # a guest may raise anything while it is imported
            reason = str(error).partition("\n")[0]
            raise self._error(
                f"{self.what} {name!r} of {_package(entry)} cannot be imported from {entry.value}: "
                f"{type(error).__name__}: {reason}; mend or uninstall that package"
            ) from error
        return self._things.setdefault(name, thing)


@functools.cache
def contrib_entries() -> tuple[EntryPoint, ...]:
    """Return the entry points of gs2d's own ``contrib``: () where that folder was removed.

    They come from the metadata of the installed package. A clone that is not installed has them in pyproject.toml.
    """
    if not (_PACKAGE / "contrib").is_dir():
        return ()
    for installed in distributions(name=_DISTRIBUTION):
        if Path(str(installed.locate_file("gs2d"))).resolve() == _PACKAGE:
            return tuple(entry for entry in installed.entry_points if entry.value.startswith(_CONTRIB))
    file = _PACKAGE.parents[1] / "pyproject.toml"
    if not file.is_file():
        return ()
    groups = tomllib.loads(file.read_text(encoding="utf-8"))["project"].get("entry-points", {})
    return tuple(EntryPoint(name, value, group) for group, names in groups.items() for name, value in names.items())


def did_you_mean(name: str, names: Sequence[str]) -> str:
    """Return "; did you mean ...?" where a name is nearly one of these, else ""."""
    near = difflib.get_close_matches(name, names, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def _package(entry: EntryPoint) -> str:
    """Return the package of an entry point, with its version."""
    return "a package without a name" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
