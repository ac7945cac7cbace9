"""Find ground truths of surfaces, and score meshes with registered evaluators."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from gs2d.config.registry import Register, Registry
from gs2d.core.mesh import Mesh
from gs2d.data.scene import Scene
from gs2d.errors import DataError

Tell = Callable[[str], None]

GENERAL = "visible-surface"  # the evaluator for captures of no known data set; asked last


class Evaluator(Protocol):
    """Scores meshes against the ground truth of a data set. Registered classes are created without arguments.

    ``has_thresholds`` states whether ``score`` uses the thresholds of the user.
    """

    has_thresholds: bool

    def find(self, capture: Path, given: Path | None, tell: Tell) -> Any | None:
        """Return the ground truth of a capture, or None if this evaluator has none for it.

        ``given`` is the file or folder that the user requested; without it, the truth may be beside the capture.
        ``tell`` receives a message about each missing file. An incomplete folder is a DataError.
        """

    def score(
        self, mesh: Mesh, truth: Any, scene: Scene, *, folder: Path, thresholds: tuple[float, ...]
    ) -> dict[str, Any]:
        """Return the ``surface`` entry of ``metrics.json`` (docs/guides/runs.md); write coloured clouds to ``folder``.

        The messages in ``self_check["messages"]`` are shown to the user.
        """


EVALUATORS: Registry[Callable[[], Evaluator]] = Registry("evaluator", "gs2d.evaluators", error=DataError)
"""Classes of evaluators, by name."""


def register_evaluator(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers an evaluator of surfaces for ``gs2d evaluate``.

    Parameters
    ----------
    name : str
        Name of the evaluator; must not be taken.

    Returns
    -------
    callable
        Decorates a class without constructor arguments that implements ``Evaluator``.
    """
    return EVALUATORS.register(name)


@dataclass(frozen=True, eq=False)
class FoundTruth:
    """A ground truth, and the evaluator that found it."""

    name: str  # of the evaluator
    evaluator: Evaluator
    truth: Any  # from ``evaluator.find``


def choose_truth(given: Path | None, capture: Path, tell: Tell) -> FoundTruth | None:
    """Return the ground truth of a capture, from the file or folder ``given``, or beside the capture.

    Evaluators of data sets come first, then the general one.

    Raise DataError if ``given`` contains no ground truth of this capture.
    """
    for name, make in sorted(EVALUATORS.working(), key=lambda item: item[0] == GENERAL):
        evaluator = make()
        truth = evaluator.find(capture, given, tell)
        if truth is not None:
            return FoundTruth(name, evaluator, truth)
    if given is not None:
        raise DataError(f"no evaluator reads {given}; evaluators: {', '.join(EVALUATORS) or 'none'}")
    return None


def check_thresholds(thresholds: tuple[float, ...]) -> None:
    """Raise DataError early for a threshold that is not a positive number."""
    if not all(t > 0 and math.isfinite(t) for t in thresholds):
        raise DataError(f"thresholds must be positive distances, got {', '.join(map(str, thresholds))}")


def score_surface(
    mesh: Mesh, found: FoundTruth, scene: Scene, *, folder: Path, tell: Tell, thresholds: tuple[float, ...] = ()
) -> dict[str, Any]:
    """Return the ``surface`` entry of ``metrics.json`` (docs/guides/runs.md); write coloured clouds to ``folder``."""
    if thresholds and not found.evaluator.has_thresholds:
        tell(f"--set thresholds is ignored: the evaluator {found.name} has its own protocol")
    facts = found.evaluator.score(mesh, found.truth, scene, folder=folder, thresholds=thresholds)
    for message in facts["self_check"]["messages"]:
        tell(message)
    return {"evaluator": found.name, **facts}
