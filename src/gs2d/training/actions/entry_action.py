"""The interface of entry actions. docs/extending.md adds one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from torch import Tensor

from gs2d.config.actions import ACTIONS, Action
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.training import events
from gs2d.training.parallel import ONE_PROCESS, OneProcess
from gs2d.training.state import TrainState


@dataclass(frozen=True, eq=False)
class StageEntry:
    """The stage that begins, and what an action may use.

    Attributes
    ----------
    stage : str
        Name of the stage, for events.
    scene : Scene
    errors : callable
        ``errors(occlusion)`` yields the inner sum of E_i [N] (paper Eq. 8) for each training view of this process.
    processes : OneProcess
        Processes that train together. A sum over views of all processes goes through ``processes.sum``.
    """

    stage: str
    scene: Scene
    errors: Callable[[bool], Iterator[Tensor]]
    processes: OneProcess = ONE_PROCESS


class EntryAction:
    """Base class of entry actions. The constructor takes the options of the recipe as keyword arguments.

    An action may change splats and row groups. Only the functions of ``training.rows`` change the number of splats. All
    choices must follow from the state, its generator and the options, so that a resumed run makes the same.
    """

    def run(self, state: TrainState, entry: StageEntry) -> Sequence[events.TrainingEvent]:
        """Change the state, and return its events."""
        raise NotImplementedError


def action_of(action: Action, stage: str) -> EntryAction:
    """Return the action of a stage, made with its options.

    Raises
    ------
    RecipeError
        If its package cannot be imported, or it does not take its options.
    """
    try:
        made: EntryAction = ACTIONS.get(action.name)(**action.options)
    except TypeError as error:
        raise RecipeError(
            f"stage {stage!r}: action {action.name!r} does not take the options {dict(action.options)}: {error}"
        ) from error
    return made
