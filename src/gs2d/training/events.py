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


# -- events of the trainer, which the log keeps ------------------------------------------------------------------------
@dataclass(frozen=True)
class Initialised:
    """The initial splats.

    Attributes
    ----------
    splats : int
    source : str
        "points" (of the scene), "sweep" (dense start), "depths" (points and known depths), "random", or "splats"
        (passed by the caller).
    dropped : int
        Unusable points.
    lacks : str
        Reason why a recipe with a dense start has none here.
    """

    kind: ClassVar[str] = "initialised"
    splats: int
    source: str
    dropped: int
    lacks: str = ""


@dataclass(frozen=True)
class StageEntering:
    """The entry actions of a stage are about to run; the splats are those of the previous stage."""

    kind: ClassVar[str] = "stage_entering"
    stage: str
    index: int
    splats: int


@dataclass(frozen=True)
class Ranked:
    """Splats were ranked by colour error. ``threshold`` is the smallest E_i of the group, ``fraction`` its share."""

    kind: ClassVar[str] = "ranked"
    stage: str
    group: str
    count: int
    threshold: float
    fraction: float


@dataclass(frozen=True)
class Cloned:
    """Splats were cloned in place."""

    kind: ClassVar[str] = "cloned"
    stage: str
    group: str
    count: int
    opacity: str
    splats: int


@dataclass(frozen=True)
class StageStarted:
    """The entry actions of a stage are done; its first iteration is next."""

    kind: ClassVar[str] = "stage_started"
    stage: str
    index: int
    iterations: int
    splats: int


@dataclass(frozen=True)
class Progress:
    """Figures of one iteration.

    Attributes
    ----------
    losses : mapping
        Weighted value of each active term; ``loss`` is their sum.
    mean_opacity : float
        Mean of o.
    mean_k_a : float
        Mean of K_a = s_u s_v (the paper's Eq. 7), world units^2.
    lr : mapping
        Learning rate of each trained attribute (means: world units).
    sh_degree : int
        Degree in training.
    """

    kind: ClassVar[str] = "progress"
    stage: str
    index: int
    iteration: int
    iterations: int
    losses: Mapping[str, float]
    loss: float
    splats: int
    mean_opacity: float
    mean_k_a: float
    lr: Mapping[str, float]
    sh_degree: int


@dataclass(frozen=True)
class Densified:
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
class OpacityLimited:
    """Opacities were reset, or capped as in AbsGS."""

    kind: ClassVar[str] = "opacity_limited"
    stage: str
    iteration: int
    ceiling: float
    reset: bool


@dataclass(frozen=True)
class FloatersRemoved:
    """Splats that were proposed for removal, and that the training images do not need, were removed."""

    kind: ClassVar[str] = "floaters_removed"
    stage: str
    iteration: int
    removed: int
    splats: int


@dataclass(frozen=True)
class StageFinished:
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
    """A phase of ``total`` steps begins (0: unknown); the previous phase is over.

    Attributes
    ----------
    name : str
    total : int
    done : int
        Steps that an interrupted run had done.
    """

    name: str
    total: int
    done: int = 0

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
    """A line for the user.

    Attributes
    ----------
    text : str
    detail : bool
        A decision that needs no action: printed with ``--verbose``, and logged in ``events.jsonl`` before training.
    is_warning : bool
        A part of the input is left out.
    """

    kind: ClassVar[str] = "notice"
    text: str
    detail: bool = False
    is_warning: bool = False


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
    """A file or a section of the result could not be made; the run continues.

    Attributes
    ----------
    what : str
        File or section.
    reason : str
        One line.
    command : str or None
        Makes it; None: the same command with ``--resume``; "": nothing does.
    error : Exception or None
    """

    what: str
    reason: str
    command: str | None = None
    error: Exception | None = None


TrainingEvent = (
    Initialised
    | StageEntering
    | Ranked
    | Cloned
    | StageStarted
    | Progress
    | Densified
    | OpacityLimited
    | FloatersRemoved
    | StageFinished
)
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
