"""What a long job tells its caller while it works. The pipeline never prints: the command line draws these."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

T = TypeVar("T")
SOON, SETTLED = 0.05, 60.0  # share of a phase, and seconds: before both, its first steps tell little of the others


@dataclass(frozen=True)
class Phase:
    """A stretch of work of ``total`` steps (0 = nobody knows) begins; the phase before it is over.

    Attributes
    ----------
    name : str
    total : int
    done : int
        Steps done before (a resumed run).
    growth : float
        Steps that grow dearer: the first share s of the steps takes the share s ** growth of the time. 1: all cost
        the same; 2: each costs in proportion to those before it, as cameras do that are adjusted with all others.
    costs : tuple of (int, float)
        Runs of steps with the relative cost of one, where costs differ; empty: all cost the same.
    """

    name: str
    total: int
    done: int = 0
    growth: float = 1.0
    costs: tuple[tuple[int, float], ...] = ()

    def seconds_left(self, done: int, elapsed: float) -> float | None:
        """Return the seconds until the phase ends, after ``elapsed`` seconds of it; None: it is too early to tell."""
        whole = self.seconds_in_all(done, elapsed)
        return None if whole is None else whole * (1.0 - self._share(min(done, self.total)))

    def seconds_in_all(self, done: int, elapsed: float) -> float | None:
        """Return the seconds that the whole phase takes, with steps that were done before; None: too early to tell.

        Parameters
        ----------
        done : int
            Steps done, with those of before.
        elapsed : float
            Seconds since the phase began.
        """
        if not self.total or done <= self.done:
            return None
        before, now = (self._share(steps) for steps in (self.done, min(done, self.total)))
        if now - before < SOON * (1.0 - before) and elapsed < SETTLED:
            return None
        return elapsed / (now - before)

    def _share(self, steps: int) -> float:
        """Return the share of the whole phase's time that its first ``steps`` take."""
        costs = self.costs or ((self.total, 1.0),)
        spent, left = 0.0, steps
        for count, cost in costs:
            spent += min(count, left) * cost
            left -= min(count, left)
        return float((spent / sum(count * cost for count, cost in costs)) ** self.growth)


@dataclass(frozen=True)
class Step:
    """So many steps of the phase are done."""

    done: int
    detail: str = ""


@dataclass(frozen=True)
class Notice:
    """A line for the user.

    Attributes
    ----------
    text : str
    detail : bool
        A decision that needs no action: printed with ``--verbose``, and logged in ``events.jsonl`` before training.
    is_warning : bool
        A part of the input is left out.
    """

    text: str
    detail: bool = False
    is_warning: bool = False


@dataclass(frozen=True)
class StageDone:
    """A stage is trained and scored; ``metrics`` is its entry of metrics.json."""

    metrics: dict[str, Any] = field(default_factory=dict)

    def line(self) -> str:
        """Return it in one line: how long, how many splats, how good."""
        metrics = self.metrics
        words = [f"{metrics['name']}: {metrics['iterations']} iterations in {metrics['seconds']:.0f} s"]
        words.append(f"{metrics['splats']:,} splats")
        for split in ("train", "test"):
            scores = metrics.get(split)
            if scores and scores.get("psnr") is not None:
                words.append(f"{split} PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f}")
        return "; ".join(words) + (" (from a cache)" if metrics.get("reused_from") else "")


@dataclass(frozen=True)
class MissingFile:
    """Something that belongs to the result could not be made; all else is there.

    Attributes
    ----------
    what : str
        File or section.
    reason : str
        One line.
    command : str or None
        Makes it again; None: the same command with ``--resume``; "": nothing does, and nothing needs it.
    error : Exception or None
    """

    what: str
    reason: str
    command: str | None = None
    error: Exception | None = None


@dataclass(frozen=True)
class Part:
    """A part of a whole run: several phases, which a person would call one thing.

    Attributes
    ----------
    name : str
    begins : tuple of str
        How the names of its own phases begin; any other phase belongs to the part in which it comes.
    of_training : float or None
        About how long it takes, as a share of the time of training; None: nobody knows beforehand.
    """

    name: str
    begins: tuple[str, ...]
    of_training: float | None = None


@dataclass(frozen=True)
class Plan:
    """What the whole run consists of, in order. A plan of some of the parts of the plan before says nothing new."""

    parts: tuple[Part, ...]


# Shares of training: the mesh of a run on 292 photographs at 780x520 took 13 % of the run, and training most of the
# rest. The shares of texture, report and scores are coarser still.
PLACED = (
    Part("photographs", ("looking for sharp frames", "taking frames", "reading photographs", "copying photographs")),
    Part("features", ("finding features",)),
    Part("matching", ("finding similar", "matching")),
    Part("cameras", ("placing", "checking the capture")),
)
_TRAINING = Part("training", ("training",))
_MESH = Part("mesh", ("rendering depth", "fusing"), of_training=0.17)
_TEXTURE = Part("texture", ("cutting the surface", "comparing the colours", "colouring the texture"), of_training=0.1)
_REPORT = Part("report", ("writing the report", "writing the page"), of_training=0.03)
TRAINED = (_TRAINING, _MESH, _REPORT)
TEXTURED_TOO = (_TRAINING, _MESH, _REPORT, _TEXTURE)
DEMO = (Part("photographs", ("photographing",)), *TRAINED, Part("scores", ("scoring the surface",), of_training=0.1))


Event = Phase | Step | Notice | StageDone | MissingFile | Plan
OnEvent = Callable[[Event], None]


def ignore(_event: Event) -> None:
    """Ignore every event: for those who do not listen."""


def counted(items: Sequence[T] | Iterable[T], name: str, total: int, on_event: OnEvent) -> Iterator[T]:
    """Iterate as a phase of ``total`` steps."""
    on_event(Phase(name, total))
    for done, item in enumerate(items, start=1):
        yield item
        on_event(Step(done))
