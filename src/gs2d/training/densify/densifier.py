"""The interface of densifiers, which add and remove splats while a stage trains. docs/extending.md adds one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor

from gs2d.config.densify import DENSIFIERS, Densify
from gs2d.config.recipe import GradDensify
from gs2d.data.scene import Scene
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from gs2d.training import events
from gs2d.training.parallel import ONE_PROCESS, ProcessGroup
from gs2d.training.state import TrainState
from gs2d.training.step_result import StepResult


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Context of a densifier."""

    stage: str  # name of the stage, for events
    scene: Scene  # sizes are compared with its ``extent`` (world units)
    settings: RasterSettings
    white: bool  # whether the background is white
    backend: Backend  # of the training; see its ``assign`` and ``accumulate``
    # Statistics of views go through ``gather``, or ``part`` and ``sum``.
    processes: ProcessGroup = ONE_PROCESS


class Densifier:
    """Base class of densifiers; changes nothing.

    The constructor takes the options of the recipe (``Densify.options``) as keyword arguments; a wrong one raises
    TypeError. Only ``training.rows.append_rows`` and ``keep_rows`` change the number of splats; they keep all data of a
    splat together. Statistics of splats are in ``state.statistics``, tensors [N, ...] by name, and are saved with the
    run. Everything else must follow from the options and the iteration, so that a resumed run does the same.

    ``shares_views``: whether it works in several processes, each with another view. It then reads ``losses``,
    ``signal`` and ``radii`` of the output only through ``surroundings.processes``, or not at all.
    """

    shares_views = False

    def __init__(self, surroundings: Surroundings) -> None:
        self.surroundings = surroundings

    def begin(self, state: TrainState) -> None:
        """Create the statistics when the stage begins."""
        state.statistics = {}

    def changes(self, iteration: int) -> bool:
        """Return whether :meth:`after_backward` may change splats or read from the device in this iteration."""
        return True

    def gathers(self, state: TrainState, iteration: int) -> Mapping[str, Tensor] | None:
        """Return the statistics that a backend may gather by itself in an iteration that changes nothing.

        The backend adds the norms of the screen gradients of visible splats to "signed", "count" and optionally
        "absolute", Tensors [N]. An empty mapping gathers nothing. :meth:`before_backward` and :meth:`after_backward`
        are then not called. None: the backend may not do that.
        """
        return None

    def before_backward(self, state: TrainState, iteration: int) -> Tensor | None:
        """Return a screen probe (rule 13 of ``render/api.py``), zeros [N, 2 or 4], or None.

        Called before the view of an iteration (from 1) is rendered. The gradient of the probe becomes
        ``output.signal``.
        """
        return None

    def after_backward(self, state: TrainState, output: StepResult, iteration: int) -> Sequence[events.TrainingEvent]:
        """Gather statistics, change splats if that is due, and return events.

        An Adam step follows, except after an event ``Densified`` (its rows are new); after ``OpacityLimited`` it skips
        the opacity. In iterations without changes (:meth:`changes`), statistics are written only by ``backend.assign``
        or ``backend.accumulate``, because a GPU may repeat the iteration.
        """
        return ()


def densifier_of(densify: GradDensify | Densify | None, surroundings: Surroundings) -> Densifier | None:
    """Return the densifier of a stage; raise RecipeError if its package or its options are wrong."""
    if densify is None:
        return None
    if isinstance(densify, GradDensify):
        densify = Densify("gradient", vars(densify))
    where, options = f"stage {surroundings.stage!r}: ", densify.options
    densifier: Densifier = DENSIFIERS.make(densify.name, surroundings, options=options, where=where)
    return densifier
