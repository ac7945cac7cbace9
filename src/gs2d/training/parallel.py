"""Several processes that train one scene, each with another view of the same iteration (views in parallel).

Each process holds the whole state. An iteration takes as many views as there are processes: each process renders one,
the gradients are averaged, and all processes do the same update. Random numbers come from generators with the same
state. Sums over all views are reduced over the processes, and process 0 decides for all. So the states stay identical
bit by bit, which :meth:`ProcessGroup.check` verifies.

The processes are connected by ``torch.distributed``, with gloo on the CPU and NCCL on GPUs. Reasons:
docs/notebook/processes.md.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed

from gs2d.core.processes import ProcessRank
from gs2d.errors import RunError
from gs2d.training.state import TrainState
from gs2d.training.step_result import StepResult

T = TypeVar("T")
Statistics = Mapping[str, Tensor]
FAILED = "gs2d/failed"  # key of the store, set when a process reports why it ends


@dataclass(frozen=True)
class Turn:
    """An iteration (from 1 in its stage) and the index of its training view."""

    iteration: int
    index: int


class LostContactError(RunError):
    """Another process of the training has ended. ``reported``: another process reports it."""

    def __init__(self, message: str, *, reported: bool) -> None:
        super().__init__(message)
        self.reported = reported


class ProcessGroup:
    """The processes that train together: this one alone, or the default group of ``torch.distributed``.

    In a single process, that without a ``place``, the collective operations do nothing. The group of several must be
    initialised. ``stop_requested`` returns whether this process has received a request to stop; ``stops`` is whether
    any process had at the last :meth:`meet`.
    """

    def __init__(self, place: ProcessRank | None = None, stop_requested: Callable[[], bool] = lambda: False) -> None:
        self.place, self.stop_requested, self.stops = place or ProcessRank(), stop_requested, False
        self._alone = self.place.size == 1

    @property
    def size(self) -> int:
        """Number of processes, and of views in a full iteration."""
        return self.place.size

    @property
    def leads(self) -> bool:
        """Whether this process writes and prints."""
        return self.place.leads

    # -- messages ------------------------------------------------------------------------------------------------------
    def broadcast(self, value: T) -> T:
        """Return the value of process 0."""
        if self._alone:
            return value
        box: list[Any] = [value]
        with self.contact():
            distributed.broadcast_object_list(box, src=0)
        received: T = box[0]
        return received

    def announce(self) -> bool:
        """Announce that this process ends and reports why; return False if another one was first."""
        try:
            store = self._store()
            return store is None or store.add(FAILED, 1) == 1
        except RuntimeError:  # the store ended with process 0
            return False

    @contextmanager
    def contact(self) -> Iterator[None]:
        """Turn a failed operation into one line: another process has ended."""
        try:
            yield
        except RuntimeError as error:
            if not isinstance(error, torch.OutOfMemoryError):
                reason = " ".join(str(error).split())[:120]
                raise LostContactError(
                    f"process {self.place.rank} of {self.size} lost contact with another process, which has ended or "
                    f"cannot be reached ({reason}); continue from the last checkpoint with --resume, with any number "
                    "of processes",
                    reported=self._is_reported(),
                ) from error
            raise

    def _store(self) -> Any:
        try:
            return distributed.distributed_c10d._get_default_store()
        except (RuntimeError, ValueError, AttributeError):
            return None

    def _is_reported(self) -> bool:
        if not self.leads:  # process 0 reports it; the store may have ended with it
            return True
        try:
            store = self._store()
            return store is not None and bool(store.check([FAILED]))
        except RuntimeError:
            return False

    # -- the state -----------------------------------------------------------------------------------------------------
    def share(self, make: Callable[[], TrainState]) -> TrainState:
        """Return the state that ``make`` returns in process 0."""
        if self._alone:
            return make()
        state = make() if self.leads else None
        received = self.broadcast(None if state is None else state.state_dict())
        return TrainState.from_state_dict(received or {}) if state is None else state

    def meet(self, state: TrainState) -> None:
        """Wait for the other processes, while process 0 may score or save; share requests to stop."""
        if self._alone:
            return
        own = torch.tensor([state.stage, state.step, len(state.splats), len(state.queue), int(self.stop_requested())])
        gathered = self._all(own)
        self.stops = bool(gathered[:, -1].any())
        self._same(gathered[:, :-1], state)

    def check(self, state: TrainState) -> None:
        """Raise RunError if a hash of splats, moments, statistics, generator and learned quantities differs."""
        if self._alone:
            return
        digest = hashlib.sha256(state.generator.get_state().numpy().tobytes() + repr(state.queue).encode())
        for tensor in _tensors(state):
            digest.update(repr((tuple(tensor.shape), _checksum(tensor))).encode())
        self._same(self._all(torch.frombuffer(bytearray(digest.digest()), dtype=torch.int64)), state)

    def _same(self, gathered: Tensor, state: TrainState) -> None:
        differing = [rank for rank, own in enumerate(gathered.tolist()) if own != gathered[0].tolist()]
        if differing:
            raise RunError(
                f"the states of processes 0 and {differing[0]} differ at iteration {state.step} of stage "
                f"{state.stage + 1}; continue from the last checkpoint with --resume"
            )

    def _all(self, own: Tensor) -> Tensor:
        """Gather a small host tensor [n] from all processes, [W, n]."""
        gathered = [torch.empty_like(own) for _ in range(self.size)]
        with self.contact():
            distributed.all_gather(gathered, own)
        return torch.stack(gathered)

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
        """Return the gradients of the mean loss of some views, and the learned gradients of each view.

        ``turns``: at most one for each process. ``one``: returns loss and gradients of one view. ``idle``: returns the
        result of a process without a view: zeros. ``rows`` [M] int64: rows that the gradients of splats are restricted
        to. ``learned``: shape of a row of each learned quantity. In the result, ``losses``, ``signal`` and ``radii``
        belong to the view of this process (:meth:`mean_losses`, :meth:`gather`).
        """
        rank = self.place.rank
        if self._alone:
            result = one(turns[0])
            return result, (result.learned,)
        result = one(turns[rank]) if rank < len(turns) else idle()
        splats = dict(result.gradients)
        if rows is not None and result.rows is None:
            splats = {name: tensor[rows] for name, tensor in splats.items()}
        splats = {name: tensor.contiguous() for name, tensor in splats.items()}
        with self.contact():
            sums = [distributed.all_reduce(splats[name], async_op=True) for name in sorted(splats)]
            for work in sums:
                work.wait()
        for tensor in splats.values():
            tensor.div_(len(turns))
        each = self._of_views(result.learned, learned)[: len(turns)] if learned else [{}] * len(turns)
        return replace(result, gradients=splats, rows=rows), each

    def _of_views(self, own: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]]) -> list[dict[str, Tensor]]:
        """Gather the learned gradients of all views, float64 in host memory."""
        parts = []
        for name, shape in shapes.items():  # a flag for a present gradient, then its numbers
            numbers = own[name].double().cpu().flatten() if name in own else torch.zeros(math.prod(shape)).double()
            parts += [numbers.new_tensor([float(name in own)]), numbers]
        gradients = []
        for view in self._all(torch.cat(parts)):
            pieces = view.split([len(part) for part in parts])
            entries = zip(shapes.items(), pieces[::2], pieces[1::2], strict=True)
            gradients.append({name: numbers.reshape(shape) for (name, shape), has, numbers in entries if has > 0})
        return gradients

    def gather(self, statistics: Statistics, result: StepResult, add: Callable[[Statistics, StepResult], Any]) -> None:
        """Add the statistics of all views of the iteration in place; ``add`` adds those of one view."""
        if self._alone:
            add(statistics, result)
            return
        own = {name: torch.zeros_like(tensor) for name, tensor in statistics.items()}
        add(own, result)
        for name in sorted(own):
            statistics[name].add_(self.sum(own[name]))

    def mean_losses(self, losses: Mapping[str, float | Tensor], views: int) -> Mapping[str, float | Tensor]:
        """Return the mean of the losses over the views; a missing term counts 0."""
        if self._alone:
            return losses
        gathered: list[Any] = [None] * self.size
        with self.contact():
            distributed.all_gather_object(gathered, {kind: float(value) for kind, value in losses.items()})
        kinds = dict.fromkeys(kind for one in gathered for kind in one)
        return {kind: sum(one.get(kind, 0.0) for one in gathered) / views for kind in kinds}

    # -- work on all views ---------------------------------------------------------------------------------------------
    def part(self, items: Sequence[T]) -> Sequence[T]:
        """Return the part of a sequence that this process works on: every W-th entry."""
        return items[self.place.rank :: self.place.size]

    def sum(self, tensor: Tensor) -> Tensor:
        """Sum a tensor over the processes in place, and return it."""
        if not self._alone:
            with self.contact():
                distributed.all_reduce(tensor)
        return tensor

    def any(self, mask: Tensor) -> Tensor:
        """Return where a mask is True in any process."""
        return self.sum(mask.to(torch.int32)) > 0

    def decide(self, judge: Callable[[], Tensor], like: Tensor, dtype: torch.dtype = torch.uint8) -> Tensor:
        """Return what ``judge`` returns in process 0, of the shape and on the device of ``like``."""
        if self._alone:
            return judge()
        decision = judge() if self.leads else torch.empty_like(like, dtype=dtype)
        with self.contact():
            distributed.broadcast(decision, src=0)
        return decision


ONE_PROCESS = ProcessGroup()


def _tensors(state: TrainState) -> Iterator[Tensor]:
    """Yield all tensors of a state, in a fixed order."""
    for name, tensor in state.splats.items():
        yield tensor
        if name in state.moments:
            yield state.moments[name].mean
            yield state.moments[name].square
    for named in (state.groups, state.statistics or {}, state.maps):
        yield from (named[name] for name in sorted(named))
    for rows in state.learned.values():
        yield rows.values
        yield rows.square


def _checksum(tensor: Tensor) -> int:
    """Return the sum of the bits of a tensor as integers; it changes with any single bit."""
    bits = tensor.detach().contiguous().view(torch.uint8 if tensor.element_size() < 4 else torch.int32)
    return int(bits.sum(dtype=torch.int64))
