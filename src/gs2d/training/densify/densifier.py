"""What a densifier is: the object that a stage asks, in every iteration, which splats come and go."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from gs2d.config.densify import DENSIFIERS, Densify
from gs2d.config.recipe import GradDensify
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from gs2d.training import events
from gs2d.training.parallel import ONE_PROCESS, OneProcess
from gs2d.training.state import TrainState

if TYPE_CHECKING:
    from gs2d.training.objective import StepResult

__all__ = ["Densifier", "Surroundings", "densifier_of"]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Where a densifier works.

    Attributes
    ----------
    stage : str
        Its name, for events.
    scene : Scene
        Its ``extent`` (world units) is what sizes are compared with.
    settings : RasterSettings
        To render with.
    white : bool
        Whether the background is white.
    backend : Backend
        That of the training: see ``assign`` and ``accumulate`` there.
    blame : callable
        ``blame(state, iteration, index)`` renders training view ``index`` as the stage trains on it now, and returns of
        each splat [N] the sum over pixels of its blending weight times how the pixel differs from the photograph, and
        that of its blending weight.
    processes : OneProcess
        Those that train together: what a densifier gathers of views goes through ``gather``, or ``part`` and
        ``sum``.
    """

    stage: str
    scene: Scene
    settings: RasterSettings
    white: bool
    backend: Backend
    blame: Callable[[TrainState, int, int], tuple[Tensor, Tensor]]
    processes: OneProcess = ONE_PROCESS


class Densifier:
    """How splats come and go in a stage; this one lets them be.

    N changes by ``training.rows.append_rows`` and ``keep_rows`` alone, which take all that belongs to a splat along:
    what a densifier gathers of each splat is in ``state.statistics``, tensors [N, ...] by name, and is saved with the
    run. All else that it needs follows from its options and the iteration, so that a run that is resumed does the same.

    Parameters
    ----------
    surroundings : Surroundings
    **options
        Of the recipe (``Densify.options``); a wrong one is a TypeError.

    Attributes
    ----------
    shares_views : bool
        Whether it may train in several processes, where an iteration has a view in each: it takes what ``output`` says
        of the view (``losses``, ``signal``, ``radii``) through ``surroundings.processes`` alone, or not at all.
    """

    shares_views = False

    def __init__(self, surroundings: Surroundings) -> None:
        self.surroundings = surroundings

    def begin(self, state: TrainState) -> None:
        """Make the statistics, when the stage begins."""
        state.statistics = {}

    def changes(self, iteration: int) -> bool:
        """Whether :meth:`after_backward` may change splats in this iteration, or look at a device."""
        return True

    def gathers(self, state: TrainState, iteration: int) -> Mapping[str, Tensor] | None:
        """Return the statistics that a backend may gather by itself in an iteration that changes nothing.

        Tensors [N], to which the norms of the screen gradients of the splats with a radius are added: "signed" and
        "count", and "absolute" where that is wanted; empty where nothing is gathered. :meth:`before_backward` and
        :meth:`after_backward` are then not called. None: they must be.
        """
        return None

    def before_backward(self, state: TrainState, iteration: int) -> Tensor | None:
        """Return the screen probe (rule 13 of ``render/api.py``) whose gradient is wanted, zeros [N, 2 or 4], or None.

        Called before the view of an iteration (from 1) is rendered.
        """
        return None

    def after_backward(self, state: TrainState, output: StepResult, iteration: int) -> Sequence[events.TrainingEvent]:
        """Gather, and change splats where that is due; return what happened.

        Adam follows, but for an iteration with an event ``Densified`` (its rows are new), and but for opacity in one
        with ``OpacityLimited``. In an iteration that does not change anything (:meth:`changes`) statistics are written
        by ``backend.assign`` or ``backend.accumulate`` alone: on a GPU it may be done again.
        """
        return ()


def densifier_of(densify: GradDensify | Densify | None, surroundings: Surroundings) -> Densifier | None:
    """Return the densifier that a stage names.

    Raises
    ------
    RecipeError
        Unknown, of a package that cannot be imported, or with options that it does not take.
    """
    if densify is None:
        return None
    if isinstance(densify, GradDensify):
        name = "multi-view-error" if densify.error_views else "absolute-gradient" if densify.absolute else "gradient"
        made: Densifier = DENSIFIERS.get(name)(surroundings, densify)
        return made
    try:
        found: Densifier = DENSIFIERS.get(densify.name)(surroundings, **densify.options)
    except TypeError as error:
        raise RecipeError(
            f"stage {surroundings.stage!r}: densifier {densify.name!r} does not take the options "
            f"{dict(densify.options)}: {error}"
        ) from error
    return found
