"""Controls of a viser page that nobody has opened."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any


class Control(SimpleNamespace):
    """A control that a test sets as a visitor would."""

    def on_update(self, call: Any) -> None:
        self.call = call

    def set(self, value: Any) -> None:
        self.value = value
        self.call(None)


class Controls:
    """The controls of a page by name; the base of what stands for a viser server, its gui and its scene."""

    def __init__(self) -> None:
        self.gui = self.scene = self
        self.controls: dict[str, Control] = {}

    def add_folder(self, *_: str, **__: Any) -> Controls:
        return self

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...

    def add_checkbox(self, name: str, *, initial_value: bool) -> Control:
        return self.controls.setdefault(name, Control(value=initial_value))
