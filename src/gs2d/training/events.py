"""Events of a training, as small frozen values. Whenever one is sent the state is whole and can be saved.

``kind`` is the name of an event in ``events.jsonl``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Initialised:
    """The start.

    ``source`` is "points" (the scene's), "sweep" (those of photographs that agree), "depths" (known ones too),
    "random", or "splats" (given); ``dropped``: unusable. ``lacks``: why there is no dense start, where the recipe would
    have one.
    """

    kind: ClassVar[str] = "initialised"
    splats: int
    source: str
    dropped: int
    lacks: str = ""


@dataclass(frozen=True)
class StageEntering:
    """A stage is about to run its entry actions; the splats are still those of the stage before."""

    kind: ClassVar[str] = "stage_entering"
    stage: str
    index: int
    splats: int


@dataclass(frozen=True)
class Ranked:
    """Splats were ranked by colour error: the group's smallest E_i, and its share of the sum of all."""

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
    """The entry actions of a stage are done; its first iteration comes next."""

    kind: ClassVar[str] = "stage_start"
    stage: str
    index: int
    iterations: int
    splats: int


@dataclass(frozen=True)
class Progress:
    """Figures of one iteration.

    Attributes
    ----------
    losses : weighted value of each active term
    loss : their sum
    mean_opacity : mean of o
    mean_k_a : mean of K_a = s_u s_v (the paper's Eq. 7), world units^2
    lr : learning rate of each trained attribute (means: world units)
    sh_degree : degree in training
    """

    kind: ClassVar[str] = "step"
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

    kind: ClassVar[str] = "densify"
    stage: str
    iteration: int
    cloned: int
    split: int
    pruned_by_opacity: int
    pruned_large: int
    splats: int


@dataclass(frozen=True)
class OpacityLimited:
    """Opacity was limited from above: a reset, or AbsGS's cap."""

    kind: ClassVar[str] = "opacity_limited"
    stage: str
    iteration: int
    ceiling: float
    reset: bool


@dataclass(frozen=True)
class FloatersRemoved:
    """Splats that something spoke against, and that the training images did not miss, were removed."""

    kind: ClassVar[str] = "floaters_removed"
    stage: str
    iteration: int
    removed: int
    splats: int


@dataclass(frozen=True)
class StageFinished:
    """A stage is done; the state already points at the next one. ``unseen`` splats, in no training view, are gone."""

    kind: ClassVar[str] = "stage_end"
    stage: str
    index: int
    iterations: int
    splats: int
    unseen: int = 0


Event = (
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
