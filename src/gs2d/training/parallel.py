"""Several processes that train one scene, each with another view of the same iteration (views in parallel).

All of them hold the whole state. An iteration takes as many views as there are processes: each process renders one,
the gradients become those of the mean of the losses, and each does the same update. What is drawn comes from the same
generator everywhere; what is decided by a look at all views is summed up, or decided by process 0 for all. So the
states stay the same to the bit, which :meth:`ManyProcesses.check` watches.

The trainer asks one object: :data:`ONE_PROCESS`, which does nothing, or :class:`ManyProcesses` (``torch.distributed``:
gloo in the host's memory, NCCL on GPUs). docs/notebook/processes.md says why it is so.
"""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from gs2d.core.processes import Place
from gs2d.core.splats import Splats
from gs2d.errors import RunError
from gs2d.training.objective import StepResult
from gs2d.training.state import TrainState

T = TypeVar("T")
Statistics = Mapping[str, Tensor]
FAILED = "gs2d/failed"  # key of the store: a process has said why it ended


@dataclass(frozen=True)
class Turn:
    """A view in an iteration (from 1 in its stage): ``index`` of the training views."""

    iteration: int
    index: int


class LostContactError(RunError):
    """Another process of the training is gone. ``told``: another one says so, or why."""

    def __init__(self, message: str, *, told: bool) -> None:
        super().__init__(message)
        self.told = told


class OneProcess:
    """A training by itself: what several processes do together is done here, and costs nothing.

    Attributes
    ----------
    place : Place
    stop_asked : bool
        Whether any process was asked to stop, as of the last meeting.
    """

    place = Place()
    stop_asked = False

    @property
    def size(self) -> int:
        """Processes in all: views of a full iteration."""
        return self.place.size

    @property
    def leads(self) -> bool:
        """Whether this process writes and prints."""
        return self.place.leads

    def share(self, make: Callable[[], TrainState]) -> TrainState:
        """Return the state that process 0 makes, or goes on from."""
        return make()

    def meet(self, state: TrainState) -> None:
        """Wait for the others at the beginning of an iteration."""

    def check(self, state: TrainState) -> None:
        """Raise RunError where the states of the processes differ."""

    def evaluate(
        self,
        turns: Sequence[Turn],
        one: Callable[[Turn], StepResult],
        idle: Callable[[], StepResult],
        *,
        rows: Tensor | None,
        learned: Mapping[str, tuple[int, ...]],
    ) -> tuple[StepResult, Sequence[Mapping[str, Tensor]]]:
        """Return the gradients of the mean loss of some views, and the learned gradients of each view.

        Parameters
        ----------
        turns : sequence of Turn
            At most as many as there are processes.
        one : callable
            Loss and gradients of one of them.
        idle : callable
            The result of a process without a view: zeros.
        rows : Tensor [M] int64, or None
            Gradients of splats may come of these rows alone; then all do.
        learned : mapping of name to shape
            What is learned of images and cameras: shape of a row.

        Returns
        -------
        StepResult
            ``losses``, ``signal`` and ``radii`` are of this process's own view (:meth:`mean_losses`, :meth:`gather`).
        sequence of mapping
            ``StepResult.learned`` of each view.
        """
        result = one(turns[0])
        return result, (result.learned,)

    def gather(self, statistics: Statistics, result: StepResult, add: Callable[[Statistics, StepResult], Any]) -> None:
        """Add what a densifier gathers of each view of the iteration to tensors, in place: ``add`` does it for one."""
        add(statistics, result)

    def mean_losses(self, losses: Mapping[str, float | Tensor], views: int) -> Mapping[str, float | Tensor]:
        """Return the mean of the losses of the views; a term that a view lacks counts as 0 there."""
        return losses

    def part(self, things: Sequence[T]) -> Sequence[T]:
        """Return the things that this process looks at, where all processes together look at all."""
        return things

    def sum(self, tensor: Tensor) -> Tensor:
        """Return the sum of a tensor over the processes, in its place."""
        return tensor

    def any(self, mask: Tensor) -> Tensor:
        """Return where a mask is True in any process."""
        return mask

    def decide(self, judge: Callable[[Splats, Tensor], Tensor], splats: Splats, known: Tensor) -> Tensor:
        """Return what ``judge`` says of each splat, uint8 [N], in process 0; ``known`` is what it knows, bool [N]."""
        return judge(splats, known)


ONE_PROCESS = OneProcess()


class ManyProcesses(OneProcess):
    """The processes of ``torch.distributed``'s default group, which must be there.

    Parameters
    ----------
    place : Place
    hears : callable
        Whether this process was asked to stop.
    """

    def __init__(self, place: Place, hears: Callable[[], bool] = lambda: False) -> None:
        import torch.distributed as distributed

        self._group = distributed
        self.place, self.hears = place, hears

    # -- words ---------------------------------------------------------------------------------------------------------
    def tell(self, facts: T) -> T:
        """Return what process 0 says, whatever the others do."""
        box: list[Any] = [facts]
        with self.contact():
            self._group.broadcast_object_list(box, src=0)
        told: T = box[0]
        return told

    def announce(self) -> bool:
        """Let the others know that this process ends, and says why; False where another one was first."""
        try:
            store = self._store()
            return store is None or store.add(FAILED, 1) == 1
        except RuntimeError:  # it was process 0's, and went with it
            return False

    @contextmanager
    def contact(self) -> Iterator[None]:
        """Say in one line that another process is gone."""
        try:
            yield
        except RuntimeError as error:
            if not isinstance(error, torch.OutOfMemoryError):
                reason = " ".join(str(error).split())[:120]
                raise LostContactError(
                    f"process {self.place.rank} of {self.size} lost contact with another one, which has ended or is "
                    f"out of reach ({reason}); go on from the last checkpoint with --resume, with any number of them",
                    told=self._was_told(),
                ) from error
            raise

    def _store(self) -> Any:
        try:
            return self._group.distributed_c10d._get_default_store()
        except (RuntimeError, ValueError, AttributeError):
            return None

    def _was_told(self) -> bool:
        if not self.leads:  # process 0 says it; and the store may be gone with it
            return True
        try:
            store = self._store()
            return store is not None and bool(store.check([FAILED]))
        except RuntimeError:
            return False

    # -- the state -----------------------------------------------------------------------------------------------------
    def share(self, make: Callable[[], TrainState]) -> TrainState:
        """Return the state that process 0 makes, or goes on from."""
        state = make() if self.leads else None
        file = io.BytesIO()
        if state is not None:
            torch.save(state.state_dict(), file)
        size = torch.tensor([file.tell()])
        with self.contact():
            self._group.broadcast(size, src=0)
        data = torch.frombuffer(file.getbuffer(), dtype=torch.uint8) if state is not None else torch.empty(0)
        data = data if state is not None else torch.empty(int(size), dtype=torch.uint8)
        with self.contact():
            self._group.broadcast(data, src=0)
        if state is not None:
            return state
        return TrainState.from_state_dict(torch.load(io.BytesIO(data.numpy().tobytes()), weights_only=True))

    def meet(self, state: TrainState) -> None:
        """Wait for the others, however long process 0 scores or saves; hear who was asked to stop."""
        own = torch.tensor([state.stage, state.step, len(state.splats), len(state.queue), int(self.hears())])
        met = self._all(own)
        self.stop_asked = bool(met[:, -1].any())
        self._same(met[:, :-1], state)

    def check(self, state: TrainState) -> None:
        """Compare a hash of the splats, Adam's memory, statistics, the generator and what is learned of views."""
        digest = hashlib.sha256(state.generator.get_state().numpy().tobytes() + repr(state.queue).encode())
        for tensor in _tensors(state):
            digest.update(repr((tuple(tensor.shape), _checksum(tensor))).encode())
        self._same(self._all(torch.frombuffer(bytearray(digest.digest()), dtype=torch.int64)), state)

    def _same(self, met: Tensor, state: TrainState) -> None:
        differing = [rank for rank, own in enumerate(met.tolist()) if own != met[0].tolist()]
        if differing:
            raise RunError(
                f"the processes must have the same state at iteration {state.step} of stage {state.stage + 1}, got "
                f"another one in process {differing[0]} than in process 0; go on from the last checkpoint with --resume"
            )

    def _all(self, own: Tensor) -> Tensor:
        """Return a small tensor of the host's memory [n] of all processes [W, n]."""
        met = [torch.empty_like(own) for _ in range(self.size)]
        with self.contact():
            self._group.all_gather(met, own)
        return torch.stack(met)

    # -- an iteration --------------------------------------------------------------------------------------------------
    def evaluate(
        self,
        turns: Sequence[Turn],
        one: Callable[[Turn], StepResult],
        idle: Callable[[], StepResult],
        *,
        rows: Tensor | None,
        learned: Mapping[str, tuple[int, ...]],
    ) -> tuple[StepResult, Sequence[Mapping[str, Tensor]]]:
        """Return the gradients of the mean loss of some views, of which this process renders one."""
        rank = self.place.rank
        result = one(turns[rank]) if rank < len(turns) else idle()
        splats = dict(result.gradients)
        if rows is not None and result.rows is None:
            splats = {name: tensor[rows] for name, tensor in splats.items()}
        splats = {name: tensor.contiguous() for name, tensor in splats.items()}
        with self.contact():
            sums = [self._group.all_reduce(splats[name], async_op=True) for name in sorted(splats)]
            for work in sums:
                work.wait()
        for tensor in splats.values():
            tensor.div_(len(turns))
        each = self._of_views(result.learned, learned)[: len(turns)] if learned else [{}] * len(turns)
        return replace(result, gradients=splats, rows=rows), each

    def _of_views(self, own: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]]) -> list[dict[str, Tensor]]:
        """Return the learned gradients of the views of all processes, float64 in host memory; the same bits."""
        parts = []
        for name, shape in shapes.items():  # whether there is a gradient, then its numbers
            numbers = own[name].double().cpu().flatten() if name in own else torch.zeros(math.prod(shape)).double()
            parts += [numbers.new_tensor([float(name in own)]), numbers]
        found = []
        for view in self._all(torch.cat(parts)):
            pieces = view.split([len(part) for part in parts])
            known = zip(shapes.items(), pieces[::2], pieces[1::2], strict=True)
            found.append({name: numbers.reshape(shape) for (name, shape), has, numbers in known if has > 0})
        return found

    def gather(self, statistics: Statistics, result: StepResult, add: Callable[[Statistics, StepResult], Any]) -> None:
        """Add what a densifier gathers of each view of the iteration to tensors, in place."""
        own = {name: torch.zeros_like(tensor) for name, tensor in statistics.items()}
        add(own, result)
        for name in sorted(own):
            statistics[name].add_(self.sum(own[name]))

    def mean_losses(self, losses: Mapping[str, float | Tensor], views: int) -> Mapping[str, float | Tensor]:
        """Return the mean of the losses of the views."""
        found: list[Any] = [None] * self.size
        with self.contact():
            self._group.all_gather_object(found, {kind: float(value) for kind, value in losses.items()})
        kinds = dict.fromkeys(kind for one in found for kind in one)
        return {kind: sum(one.get(kind, 0.0) for one in found) / views for kind in kinds}

    # -- looks at all views --------------------------------------------------------------------------------------------
    def part(self, things: Sequence[T]) -> Sequence[T]:
        """Return every so many-th thing."""
        return things[self.place.rank :: self.size]

    def sum(self, tensor: Tensor) -> Tensor:
        """Return the sum of a tensor over the processes, in its place."""
        with self.contact():
            self._group.all_reduce(tensor)
        return tensor

    def any(self, mask: Tensor) -> Tensor:
        """Return where a mask is True in any process."""
        return self.sum(mask.to(torch.int32)) > 0

    def decide(self, judge: Callable[[Splats, Tensor], Tensor], splats: Splats, known: Tensor) -> Tensor:
        """Return what ``judge`` says in process 0."""
        nothing = torch.empty(len(splats), dtype=torch.uint8, device=splats.device)
        found = judge(splats, known) if self.leads else nothing
        with self.contact():
            self._group.broadcast(found, src=0)
        return found


def _tensors(state: TrainState) -> Iterator[Tensor]:
    """Yield all tensors of a state, in a fixed order."""
    for name, tensor in state.splats.items():
        yield tensor
        if name in state.moments:
            yield state.moments[name].mean
            yield state.moments[name].square
    for named in (state.groups, state.statistics or {}):
        yield from (named[name] for name in sorted(named))
    for rows in state.learned.values():
        yield rows.values
        yield rows.square


def _checksum(tensor: Tensor) -> int:
    """Return the sum of a tensor's bits, as whole numbers: cheap, and another one where a single bit is."""
    bits = tensor.detach().contiguous().view(torch.uint8 if tensor.element_size() < 4 else torch.int32)
    return int(bits.sum(dtype=torch.int64))
