"""What a long job tells its caller while it works. The pipeline never prints: the command line draws these."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Phase:
    """A stretch of work of ``total`` steps (0 = nobody knows) begins; the phase before it is over."""

    name: str
    total: int
    done: int = 0  # steps done before (a resumed run)


@dataclass(frozen=True)
class Step:
    """So many steps of the phase are done."""

    done: int
    detail: str = ""


@dataclass(frozen=True)
class Notice:
    """Something the user should know: what was chosen for him, skipped or found odd."""

    text: str


@dataclass(frozen=True)
class StageDone:
    """A stage is trained and scored; ``metrics`` is its entry of metrics.json."""

    metrics: dict[str, Any] = field(default_factory=dict)


Event = Phase | Step | Notice | StageDone
OnEvent = Callable[[Event], None]


def ignore(_event: Event) -> None:
    """The listener of those who do not listen."""


def counted(items: Sequence[T] | Iterable[T], name: str, total: int, on_event: OnEvent) -> Iterator[T]:
    """Iterate as a phase of ``total`` steps."""
    on_event(Phase(name, total))
    for done, item in enumerate(items, start=1):
        yield item
        on_event(Step(done))
