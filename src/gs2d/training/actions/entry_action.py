"""The interface of entry actions. docs/extending.md adds one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from torch import Tensor

from gs2d.data.scene import Scene
from gs2d.training import events
from gs2d.training.parallel import ONE_PROCESS, ProcessGroup
from gs2d.training.state import TrainState


@dataclass(frozen=True, eq=False)
class StageEntry:
    """The stage that begins, and what an action may use."""

    stage: str  # name of the stage, for events
    scene: Scene
    # ``errors(occlusion)`` yields the inner sum of E_i [N] (paper Eq. 8) for each training view of this process.
    errors: Callable[[bool], Iterator[Tensor]]
    # A sum over views of all processes goes through ``processes.sum``.
    processes: ProcessGroup = ONE_PROCESS


class EntryAction:
    """Base class of entry actions. The constructor takes the options of the recipe as keyword arguments.

    An action may change splats and row groups. Only the functions of ``training.rows`` change the number of splats. All
    choices must follow from the state, its generator and the options, so that a resumed run makes the same.
    """

    def run(self, state: TrainState, entry: StageEntry) -> Sequence[events.TrainingEvent]:
        """Change the state, and return its events."""
        raise NotImplementedError
