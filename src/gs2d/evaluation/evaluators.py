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

Notify = Callable[[str], None]

GENERAL = "visible-surface"  # the evaluator for captures of other data sets; tried last


class Evaluator(Protocol):
    """Scores meshes against the ground truth of a data set. Registered classes are created without arguments.

    ``has_thresholds`` states whether ``score`` uses the thresholds of the user.
    """

    has_thresholds: bool

    def find(self, capture: Path, ground_truth: Path | None, notify: Notify) -> Any | None:
        """Return the ground truth of a capture, or None if this evaluator has none for it.

        ``ground_truth`` is the file or folder of the user; None: the truth may be beside the capture.
        ``notify`` receives a message about each missing file. An incomplete folder is a DataError.
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
        Name of the evaluator; must not be registered already.

    Returns
    -------
    callable
        Decorates a class without constructor arguments that implements ``Evaluator``.
    """
    return EVALUATORS.register(name)


@dataclass(frozen=True, eq=False)
class SurfaceTruth:
    """A ground truth, and its evaluator."""

    name: str  # name of the evaluator
    evaluator: Evaluator
    truth: Any  # from ``evaluator.find``


def choose_truth(ground_truth: Path | None, capture: Path, notify: Notify) -> SurfaceTruth | None:
    """Return the ground truth of a capture, from the file or folder ``ground_truth``, or beside the capture.

    Evaluators of data sets come first, then the general one.

    Raise DataError if ``ground_truth`` contains no ground truth of this capture.
    """
    for name, make in sorted(EVALUATORS.working(), key=lambda item: item[0] == GENERAL):
        evaluator = make()
        truth = evaluator.find(capture, ground_truth, notify)
        if truth is not None:
            return SurfaceTruth(name, evaluator, truth)
    if ground_truth is not None:
        raise DataError(f"no evaluator reads {ground_truth}; evaluators: {', '.join(EVALUATORS) or 'none'}")
    return None


def check_thresholds(thresholds: tuple[float, ...]) -> None:
    """Raise DataError early for a threshold that is not a positive number."""
    if not all(t > 0 and math.isfinite(t) for t in thresholds):
        raise DataError(f"thresholds must be positive distances, got {', '.join(map(str, thresholds))}")


def score_surface(
    mesh: Mesh, truth: SurfaceTruth, scene: Scene, *, folder: Path, notify: Notify, thresholds: tuple[float, ...] = ()
) -> dict[str, Any]:
    """Return the ``surface`` entry of ``metrics.json`` (docs/guides/runs.md); write coloured clouds to ``folder``."""
    if thresholds and not truth.evaluator.has_thresholds:
        notify(f"--set thresholds is ignored: the evaluator {truth.name} has its own protocol")
    scores = truth.evaluator.score(mesh, truth.truth, scene, folder=folder, thresholds=thresholds)
    for message in scores["self_check"]["messages"]:
        notify(message)
    return {"evaluator": truth.name, **scores}
