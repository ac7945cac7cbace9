"""Extension points: named objects that gs2d, programs and installed packages register.

Each kind (loss, capture reader, command, ...) is one :class:`Registry`. A decorator registers an object; an installed
package declares an entry point. ``gs2d.contrib`` is registered by the entry points of gs2d itself. Pure Python; never
imports torch.
"""

from __future__ import annotations

import difflib
import functools
import tomllib
import traceback
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

__all__ = ["Register", "Registry", "absent_guests", "did_you_mean", "origin_of"]

T = TypeVar("T")
Register = TypeVar("Register")
_ABSENT = ContextVar("absent guests", default=False)
_PACKAGE = Path(__file__).resolve().parents[1]
_DISTRIBUTION, _CONTRIB = "2dgs-r", "gs2d.contrib."
_REGISTRIES: list[Registry[Any]] = []


@contextmanager
def absent_guests() -> Iterator[None]:
    """Accept unknown names, because the recipe of a finished run may name a package that is no longer installed."""
    token = _ABSENT.set(True)
    try:
        yield
    finally:
        _ABSENT.reset(token)


class Registry(Generic[T]):
    """Objects by name: those of gs2d, of programs and of installed packages.

    Nothing is imported before it is used. If a package cannot be imported, only the use of its objects fails, with a
    one-line error. ``what``: kind of the objects: "loss". ``group``: group of entry points: "gs2d.losses". ``builtin``:
    objects of gs2d, and the modules that register them when they are imported. ``error``: error for a wrong name.
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
        self._objects: dict[str, T] = {}
        _REGISTRIES.append(self)

    @cached_property
    def _homes(self) -> dict[str, str]:
        """Modules of gs2d by the names that they register: those of the core, then those of contrib."""
        return self._core | {entry.name: entry.module for entry in contrib_entries() if entry.group == self.group}

    def register(self, name: str, *, module: str | None = None) -> Callable[[Register], Register]:
        """Return a decorator that registers an object under a name.

        ``module`` is the module that defines the object, if its ``__module__`` is another one. The decorator raises
        Gs2dError if the name is taken.
        """

        def registered(entry: Register) -> Register:
            home = module or getattr(entry, "__module__", "")
            if self._homes.get(name, home) != home:
                raise self._error(f"{self.what} {name!r} belongs to gs2d; use another name")
            existing = self._objects.get(name)
            if existing is not None and existing is not entry:
                raise self._error(
                    f"{self.what} {name!r} is already registered by {getattr(existing, '__module__', 'another')}; use "
                    "another name"
                )
            self._objects[name] = entry  # type: ignore[assignment]
            return entry

        return registered

    def get(self, name: str) -> T:
        """Return the object of a name, and import it if necessary.

        Raises Gs2dError if the name is unknown, or its package cannot be imported.
        """
        if name in self._homes and name not in self._objects:
            import_module(self._homes[name])
        if name in self._objects:
            return self._objects[name]
        if name in self._offered:
            return self._load(name)
        raise self._error(self.unknown(name))

    def make(self, name: str, *arguments: object, options: Mapping[str, Any], where: str = "") -> Any:
        """Return an object of a registered class with its options; ``where`` begins the error message.

        Raises Gs2dError as :meth:`get`, or if the class does not take the options.
        """
        kind: Any = self.get(name)
        try:
            return kind(*arguments, **options)
        except TypeError as error:
            raise self._error(
                f"{where}{self.what} {name!r} does not take the options {dict(options)}: {error}"
            ) from error

    def __getitem__(self, name: str) -> T:
        return self.get(name)

    def unknown(self, name: str, *, also: Sequence[str] = ()) -> str:
        """Return the error message for an unknown name; ``also``: further valid values."""
        names = (*also, *self.names())
        return f"{self.what} must be one of {', '.join(names)}, got {name!r}{did_you_mean(name, names)}"

    def check(self, name: object) -> None:
        """Raise for an unknown name, unless :func:`absent_guests` allows it.

        Nothing is imported. A program must register its names before it builds a recipe with them. The Gs2dError
        lists the names and suggests the nearest one.
        """
        if name not in self and not _ABSENT.get():
            text = self.unknown(str(name))
            raise self._error(text if text.endswith("?") else f"{text}; gs2d.register_{self.what} adds one")

    @property
    def builtin(self) -> tuple[str, ...]:
        """The names of gs2d itself."""
        return tuple(self._homes)

    def names(self) -> tuple[str, ...]:
        """Return all names: those of gs2d, of this program and of packages."""
        return tuple(dict.fromkeys((*self._homes, *self._objects, *self._offered)))

    def guests(self) -> tuple[str, ...]:
        """Return the names that do not belong to gs2d."""
        return tuple(name for name in self.names() if name not in self._homes)

    def working(self, names: Sequence[str] | None = None) -> Iterator[tuple[str, T]]:
        """Yield names (default: all) with their objects; warn (PluginWarning) about those that cannot be imported."""
        for name in self.names() if names is None else names:
            try:
                yield name, self.get(name)
            except Gs2dError as error:
                if name in self._homes:
                    raise
                warnings.warn(str(error), PluginWarning, stacklevel=2)

    def source(self, name: str) -> str:
        """Return the origin of an object: "gs2d", a package with its version, or a module of this program."""
        if name in self._homes:
            return "gs2d"
        if name in self._offered:
            return _package(self._offered[name])
        return str(getattr(self._objects.get(name), "__module__", "this program"))

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and (name in self._homes or name in self._objects or name in self._offered)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())

    def __len__(self) -> int:
        return len(self.names())

    @cached_property
    def _offered(self) -> dict[str, EntryPoint]:
        """Entry points of installed packages by name; the first package keeps a name."""
        offered: dict[str, EntryPoint] = {}
        guests = [entry for entry in entry_points(group=self.group) if not entry.value.startswith(_CONTRIB)]
        for entry in sorted(guests, key=_package):
            owner = "gs2d" if entry.name in self._homes else None
            if entry.name in offered and offered[entry.name].value != entry.value:
                owner = _package(offered[entry.name])
            if owner is None:
                offered[entry.name] = entry
            else:
                text = f"{_package(entry)} declares the {self.what} {entry.name!r} of {owner}; it is ignored"
                warnings.warn(text, PluginWarning, stacklevel=3)
        return offered

    def _load(self, name: str) -> T:
        entry = self._offered[name]
        try:
            loaded: Any = entry.load()
        except Exception as error:  # a plug-in may raise anything
            reason = str(error).partition("\n")[0]
            raise self._error(
                f"{self.what} {name!r} of {_package(entry)} cannot be imported from {entry.value}: "
                f"{type(error).__name__}: {reason}; fix or uninstall that package"
            ) from error
        return self._objects.setdefault(name, loaded)


def origin_of(error: BaseException) -> str:
    """Return whose code raised an error: "loss 'tint' of example 1.0" if the traceback passes a plug-in, or "gs2d"."""
    for frame, _ in reversed(list(traceback.walk_tb(error.__traceback__))):
        module, scope = frame.f_globals.get("__name__"), f"{frame.f_code.co_qualname}."
        for registry in _REGISTRIES:
            for name in registry.guests():
                entry: Any = registry._objects.get(name)
                home, qualname = getattr(entry, "__module__", ""), getattr(entry, "__qualname__", "")
                if home == module and scope.startswith(f"{qualname}."):
                    return f"{registry.what} {name!r} of {registry.source(name)}"
    return "gs2d"


@functools.cache
def contrib_entries() -> tuple[EntryPoint, ...]:
    """Return the entry points of ``gs2d.contrib``; () if that folder was removed.

    They come from the metadata of the installed package, or from pyproject.toml in a clone that is not installed.
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
    """Return "; did you mean ...?" for the nearest of the names, else ""."""
    near = difflib.get_close_matches(name, names, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def _package(entry: EntryPoint) -> str:
    """Return the package of an entry point, with its version."""
    return "a package without a name" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
