"""Splats sharded over several processes, for scenes beyond one card: each has a part of the rows, and renders a view.

What costs memory in training, parameters, gradients, Adam's memory and statistics, is there once, not once a process.
An iteration has a view in each process, as where all have all splats; how views are rendered then is in
:mod:`gs2d.training.split_views`.

Rows keep the order that one process would have them in: whenever splats come or go, each gets an equal share of them
again. So rankings, draws and what is drawn first of two splats in one place are those of one process with batches of as
many views, and results agree to rounding (tests/training/test_shards.py; docs/decisions/processes.md).
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gs2d.core.splats import Splats
from gs2d.training.objective import StepResult
from gs2d.training.parallel import ManyProcesses, Statistics
from gs2d.training.parts import WHOLE, Whole
from gs2d.training.rows import change_rows
from gs2d.training.state import TrainState

GO_ON, WHOLE_STATE = 0, 1  # what process 0 says to those that attend


@dataclass(frozen=True, eq=False)
class Plan:
    """How rows move between the processes.

    Attributes
    ----------
    sources : Tensor [n]
        For each row that this process will have, which of its own it is; 0 where another process has it.
    places : Tensor [k]
        Where the rows go that come from others, ``received`` from each.
    leaving : Tensor [m]
        Own rows for others, ``sent`` to each.
    """

    sources: Tensor
    places: Tensor
    received: list[int]
    leaving: Tensor
    sent: list[int]


@dataclass(frozen=True, eq=False)
class Seen:
    """What came back of a view: rows [M] of this process that were sent there, their screen gradients and radii."""

    rows: Tensor
    signal: Tensor | None
    radii: Tensor


@dataclass(frozen=True, eq=False)
class SplitResult(StepResult):
    """Gradients of this process's own splats, and what each view of the iteration says of them."""

    seen: tuple[Seen, ...] = ()


class Shards(ManyProcesses, Whole):
    """The processes of ``torch.distributed``'s default group, where each has a part of the splats."""

    splits = True

    # -- all rows ------------------------------------------------------------------------------------------------------
    def count(self, own: int) -> int:
        """Return a number of rows, added up over the processes."""
        return int(self._all(torch.tensor([own])).sum())

    def total(self, own: Tensor) -> Tensor:
        """Return sums over rows, of all processes."""
        return self.sum(own.clone())

    def mean(self, own: Tensor) -> float:
        """Return the mean of numbers of rows [N]."""
        facts = self._all(torch.tensor([float(own.double().sum()), len(own)], dtype=torch.float64)).sum(dim=0)
        return float(facts[0] / facts[1])

    def whole(self, own: Tensor) -> Tensor:
        """Return numbers of rows [n] of all processes [N], in the order of rows."""
        lengths = self._lengths(own)
        longest = max(lengths)
        plain = own.to(torch.uint8) if own.dtype == torch.bool else own
        padded = torch.cat([plain, plain.new_zeros(longest - len(plain), *plain.shape[1:])]).contiguous()
        found = [torch.empty_like(padded) for _ in lengths]
        with self.contact():
            self._group.all_gather(found, padded)
        return torch.cat([part[:length] for part, length in zip(found, lengths, strict=True)]).to(own.dtype)

    def own(self, whole: Tensor, like: Tensor) -> Tensor:
        """Return those of all numbers of rows [N] that belong to this process, of which ``like`` [n] are as many."""
        first = sum(self._lengths(like)[: self.place.rank])
        return whole[first : first + len(like)]

    def normal(self, generator: torch.Generator, pieces: Sequence[int], columns: int, dtype: torch.dtype) -> Tensor:
        """Draw normal numbers [n, columns] for some rows: all processes draw those of all."""
        lengths = self._all(torch.tensor(pieces))  # [W, P]
        drawn = torch.randn(int(lengths.sum()), columns, generator=generator, dtype=dtype)
        own = [slice(start, start + length) for start, length in zip(self._starts(lengths), pieces, strict=True)]
        return torch.cat([drawn[rows] for rows in own])

    def settle(self, state: TrainState, pieces: Sequence[int]) -> None:
        """Give each process an equal share of the rows, in their order."""
        lengths = self._all(torch.tensor([len(state.splats) - sum(pieces), *pieces]))
        total = int(lengths.sum())
        plan = self._plan(lengths, [total * (rank + 1) // self.size for rank in range(self.size)])
        change_rows(state, lambda tensor: self._moved(tensor, plan))

    def _lengths(self, own: Tensor) -> list[int]:
        """Return how many rows each process has."""
        return [int(length) for length in self._all(torch.tensor([len(own)]))[:, 0]]

    def _starts(self, lengths: Tensor) -> list[int]:
        """Return where this process's part of each piece begins, of lengths [W, P]."""
        before = lengths.sum(dim=0).cumsum(0) - lengths.sum(dim=0)
        return (before + lengths[: self.place.rank].sum(dim=0)).tolist()

    # -- rows that move ------------------------------------------------------------------------------------------------
    def _plan(self, lengths: Tensor, ends: Sequence[int]) -> Plan:
        """Return how rows move, of which each process has some of each piece [W, P], to where they end in each."""
        rank, begins = self.place.rank, [0, *ends]
        own = zip(self._starts(lengths), lengths[rank].tolist(), strict=True)
        places = torch.cat([torch.arange(start, start + length) for start, length in own])
        goal = torch.searchsorted(torch.tensor(ends), places, right=True)
        leaving = torch.sort(goal, stable=True).indices
        leaving = leaving[goal[leaving] != rank]
        given = [places[leaving[goal[leaving] == other]] for other in range(self.size)]
        coming, received = self.delivered(given)
        sources = torch.zeros(ends[rank] - begins[rank], dtype=torch.int64)
        staying = (goal == rank).nonzero().squeeze(1)
        sources[places[staying] - begins[rank]] = staying
        return Plan(sources, coming - begins[rank], received, leaving, [len(rows) for rows in given])

    def _moved(self, tensor: Tensor, plan: Plan) -> Tensor:
        """Return the rows of a tensor that this process has when all have moved."""
        here = tensor.device
        coming = self.exchanged(tensor[plan.leaving.to(here)], plan.sent, plan.received)
        if len(tensor):
            result = torch.index_select(tensor, 0, plan.sources.to(here))
        else:
            result = tensor.new_zeros(len(plan.sources), *tensor.shape[1:])
        result[plan.places.to(here)] = coming
        return result

    def delivered(self, given: Sequence[Tensor]) -> tuple[Tensor, list[int]]:
        """Return the rows that the processes send to this one, which gives each a tensor, and how many each sent."""
        to = torch.tensor([len(tensor) for tensor in given])
        of = torch.empty_like(to)
        with self.contact():
            self._group.all_to_all_single(of, to)
        return self.exchanged(torch.cat(list(given)), to.tolist(), of.tolist()), of.tolist()

    def exchanged(self, sent: Tensor, to: Sequence[int], of: Sequence[int]) -> Tensor:
        """Return the rows that the processes send to this one, ``of`` each so many, for ``to`` each so many."""
        plain = sent.to(torch.uint8) if sent.dtype == torch.bool else sent
        received = plain.new_empty(sum(of), *plain.shape[1:])
        with self.contact():
            self._group.all_to_all_single(received, plain.contiguous(), list(of), list(to))
        return received.to(sent.dtype)

    # -- the state -----------------------------------------------------------------------------------------------------
    def share(self, make: Callable[[], TrainState]) -> TrainState:
        """Return this process's part of the state that process 0 makes, or goes on from."""
        state, file = make() if self.leads else None, io.BytesIO()
        if state is not None:
            torch.save(_emptied(state).state_dict(), file)
        skeleton = self.tell(file.getvalue())
        if state is None:
            state = TrainState.from_state_dict(torch.load(io.BytesIO(skeleton), weights_only=True))
        state.parts = self
        self.settle(state, ())
        return state

    def whole_state(self, state: TrainState) -> TrainState:
        """Return a state with all splats, to process 0 while the others attend."""
        self._say(WHOLE_STATE)
        return self._gathered(state)

    def attend(self, state: TrainState) -> None:
        """Be there for process 0 while it tells somebody of an event, and may want the whole state."""
        while self._say(GO_ON) == WHOLE_STATE:
            self._gathered(state)

    def dismiss(self) -> None:
        """Let the others go on, who attend."""
        self._say(GO_ON)

    def end(self, state: TrainState) -> TrainState:
        """Return the state with all splats to process 0, when all have come to the end."""
        return self._gathered(state)

    def _gathered(self, state: TrainState) -> TrainState:
        """Return to process 0 a state with all splats, which are where its own are, and all else in the host's memory.

        To the others one with none.
        """
        lengths, whole = self._all(torch.tensor([len(state.splats)])), _copied(state)
        plan = self._plan(lengths, [int(lengths.sum())] * self.size)
        change_rows(whole, lambda tensor: self._moved(tensor.detach().cpu(), plan))
        whole.splats = whole.splats.to(state.splats.device)
        return whole

    def _say(self, word: int) -> int:
        """Return the word that process 0 says."""
        said = torch.tensor([word])
        with self.contact():
            self._group.broadcast(said, src=0)
        return int(said)

    def meet(self, state: TrainState) -> None:
        """Wait for the others; hear who was asked to stop."""
        own = torch.tensor([state.stage, state.step, len(state.queue), int(self.hears())])
        met = self._all(own)
        self.stop_asked = bool(met[:, -1].any())
        self._same(met[:, :-1], state)

    def check(self, state: TrainState) -> None:
        """Compare a hash of the generator and of what is learned of views: of splats each has others."""
        super().check(_emptied(state))

    # -- an iteration --------------------------------------------------------------------------------------------------
    def gather(self, statistics: Statistics, result: StepResult, add: Callable[[Statistics, StepResult], Any]) -> None:
        """Add what a densifier gathers of each view of the iteration to tensors, in place."""
        assert isinstance(result, SplitResult)
        for seen in result.seen:
            own = {name: torch.zeros_like(tensor) for name, tensor in statistics.items()}
            count = len(next(iter(own.values())))
            signal = None if seen.signal is None else spread(seen.signal, seen.rows, count)
            add(own, replace(result, signal=signal, radii=spread(seen.radii, seen.rows, count)))
            for name, tensor in statistics.items():
                tensor.add_(own[name])

    def part(self, things: Sequence[Any]) -> Sequence[Any]:
        """Return all: each process looks at its own splats in every view."""
        return things

    def sum_views(self, tensor: Tensor) -> Tensor:
        """Return the same: every process has all views of its own splats."""
        return tensor

    def any(self, mask: Tensor) -> Tensor:
        """Return the same."""
        return mask

    def decide(self, judge: Callable[[Splats, Tensor], Tensor], splats: Splats, known: Tensor) -> Tensor:
        """Return what ``judge`` says of all splats in process 0, uint8 [n]."""
        every = Splats(**{name: self.whole(tensor.detach()) for name, tensor in splats.items()})
        spared = self.whole(known.to(torch.uint8)).bool()
        found = judge(every, spared) if self.leads else torch.empty_like(spared, dtype=torch.uint8)
        with self.contact():
            self._group.broadcast(found, src=0)
        return self.own(found, splats.means)


def spread(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """Return what belongs to some rows [M, ...] of all [count, ...]; 0 elsewhere."""
    return values.new_zeros(count, *values.shape[1:]).index_copy_(0, rows, values)


def _copied(state: TrainState) -> TrainState:
    """Return a state of the same tensors, of which rows may be changed; no part of one in several processes."""
    return replace(state, parts=WHOLE, moments={name: replace(moments) for name, moments in state.moments.items()})


def _emptied(state: TrainState) -> TrainState:
    """Return a state without rows."""
    empty = _copied(state)
    change_rows(empty, lambda tensor: tensor[:0])
    return empty
