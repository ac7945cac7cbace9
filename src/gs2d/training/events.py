"""Events of a run, as small frozen values: the trainer, the pipeline, the log and the console all use these.

Events of the trainer are sent while its state is complete and can be saved. ``kind`` is the name of an event in
``events.jsonl``. The log has two more kinds: ``notice`` (a detail) and ``processes`` (their number).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

T = TypeVar("T")
MIN_SHARE, MIN_SECONDS = 0.05, 60.0  # of a phase; time left is unknown until one of them has passed


@dataclass(frozen=True)
class TrainingEvent:
    """Base class of the events of the trainer, which the log keeps."""

    kind: ClassVar[str]


# -- events of the trainer ---------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Initialised(TrainingEvent):
    """The initial splats."""

    kind: ClassVar[str] = "initialised"
    splats: int
    # "points" (of the scene), "sweep" (dense start), "depths" (points on depth maps), "random", or "splats"
    # (passed by the caller)
    source: str
    dropped: int  # unusable points
    lacks: str = ""  # reason why a recipe with a dense start has none here


@dataclass(frozen=True)
class StageEntering(TrainingEvent):
    """The entry actions of a stage are about to run; the splats are those of the previous stage."""

    kind: ClassVar[str] = "stage_entering"
    stage: str
    index: int
    splats: int


@dataclass(frozen=True)
class Ranked(TrainingEvent):
    """Splats were ranked by colour error. ``threshold`` is the smallest E_i of the group, ``fraction`` its share."""

    kind: ClassVar[str] = "ranked"
    stage: str
    group: str
    count: int
    threshold: float
    fraction: float


@dataclass(frozen=True)
class Cloned(TrainingEvent):
    """Splats were cloned in place."""

    kind: ClassVar[str] = "cloned"
    stage: str
    group: str
    count: int
    opacity: str
    splats: int


@dataclass(frozen=True)
class StageStarted(TrainingEvent):
    """The entry actions of a stage are done; its first iteration is next."""

    kind: ClassVar[str] = "stage_started"
    stage: str
    index: int
    iterations: int
    splats: int


@dataclass(frozen=True)
class Progress(TrainingEvent):
    """Figures of one iteration."""

    kind: ClassVar[str] = "progress"
    stage: str
    index: int
    iteration: int
    iterations: int
    losses: Mapping[str, float]  # weighted value of each active term; ``loss`` is their sum
    loss: float
    splats: int
    mean_opacity: float  # mean of o
    mean_k_a: float  # mean of K_a = s_u s_v (the paper's Eq. 7), world units^2
    lr: Mapping[str, float]  # learning rate of each trained attribute (means: world units)
    sh_degree: int  # degree in training


@dataclass(frozen=True)
class Densified(TrainingEvent):
    """Splats were cloned, split and pruned."""

    kind: ClassVar[str] = "densified"
    stage: str
    iteration: int
    cloned: int
    split: int
    pruned_by_opacity: int
    pruned_large: int
    splats: int


@dataclass(frozen=True)
class OpacityLimited(TrainingEvent):
    """Opacities were reset, or capped as in AbsGS."""

    kind: ClassVar[str] = "opacity_limited"
    stage: str
    iteration: int
    ceiling: float
    reset: bool


@dataclass(frozen=True)
class FloatersRemoved(TrainingEvent):
    """Splats that were proposed for removal, and that the training images do not need, were removed."""

    kind: ClassVar[str] = "floaters_removed"
    stage: str
    iteration: int
    removed: int
    splats: int


@dataclass(frozen=True)
class StageFinished(TrainingEvent):
    """A stage is trained; the state points at the next one. ``unseen`` splats, in no training view, were removed."""

    kind: ClassVar[str] = "stage_finished"
    stage: str
    index: int
    iterations: int
    splats: int
    unseen: int = 0


# -- events of the pipeline, which the console shows -------------------------------------------------------------------
@dataclass(frozen=True)
class Phase:
    """A phase of ``total`` steps begins (0: unknown); the previous phase is over."""

    name: str
    total: int
    done: int = 0  # steps that an interrupted run had done

    def seconds_left(self, done: int, elapsed: float) -> float | None:
        """Return the seconds until the phase ends, after ``elapsed`` seconds; None: too early to estimate."""
        steps, rest = done - self.done, max(self.total - done, 0)
        if not self.total or steps <= 0:
            return None
        if steps < MIN_SHARE * (steps + rest) and elapsed < MIN_SECONDS:
            return None
        return elapsed * rest / steps


@dataclass(frozen=True)
class Step:
    """The number of steps of the phase that are done."""

    done: int
    detail: str = ""


@dataclass(frozen=True)
class Notice:
    """A line for the user."""

    kind: ClassVar[str] = "notice"
    text: str
    # A decision that needs no action: printed with ``--verbose``, and logged in ``events.jsonl`` before training.
    detail: bool = False
    is_warning: bool = False  # a part of the input is ignored


@dataclass(frozen=True)
class StageScored:
    """A finished stage was scored; ``metrics`` is its entry of ``metrics.json``."""

    metrics: dict[str, Any] = field(default_factory=dict)

    def line(self) -> str:
        """Return time, number of splats and scores in one line."""
        metrics = self.metrics
        words = [f"{metrics['name']}: {metrics['iterations']} iterations in {metrics['seconds']:.0f} s"]
        words.append(f"{metrics['splats']:,} splats")
        for split in ("train", "test"):
            scores = metrics.get(split)
            if scores and scores.get("psnr") is not None:
                words.append(f"{split} PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f}")
        return "; ".join(words) + (" (from a cache)" if metrics.get("reused_from") else "")


@dataclass(frozen=True)
class NotMade:
    """A file or a section of the result could not be written; the run continues."""

    what: str  # file or section
    reason: str  # one line
    command: str | None = None  # makes it; None: the same command with ``--resume``; "": nothing does
    error: Exception | None = None


Event = TrainingEvent | Phase | Step | Notice | StageScored | NotMade
OnEvent = Callable[[Event], None]


def ignore(_event: Any) -> None:
    """Ignore an event."""


def counted(items: Iterable[T], name: str, total: int, on_event: OnEvent) -> Iterator[T]:
    """Iterate as a phase of ``total`` steps."""
    on_event(Phase(name, total))
    for done, item in enumerate(items, start=1):
        yield item
        on_event(Step(done))
