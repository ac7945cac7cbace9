"""Room for the pairs of a view without asking the device for their number."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

__all__ = ["MAX_PAIRS", "PairBudget", "room_for"]

SLACK = 1.25  # room, in the largest number seen
STEP = 1 << 16  # room is a multiple of it, so that torch's allocator sees few sizes
FORGET = 1 / 1024  # share of the largest number that goes with each rendering: room that is not used is sorted too
MAX_PAIRS = (1 << 31) - 1


class PairBudget:
    """How much room the renderings of a training run make for pairs of splat and tile.

    The first rendering of a size waits for the number of pairs. Later ones take SLACK times the largest number so far,
    which is slowly forgotten, and wait for nothing; if that is too little, the pairs farthest away are left out, which
    ``overflow`` says on the device at once, and ``overflowed`` on the host afterwards. So an update that reads
    ``overflow`` does nothing, and the caller renders again with ``exact`` set. Both speak of all renderings since the
    last ``overflowed``: an iteration may render two views.

    Attributes
    ----------
    exact : bool
        The next renderings wait for the number.
    overflow : Tensor [] int32 or None
        On the device: whether a rendering lacks pairs. None where all were exact.
    """

    def __init__(self) -> None:
        self.exact = False
        self.overflow: Tensor | None = None
        self._largest: dict[int, float] = {}  # by the number of tiles
        self._asked: list[tuple[int, int]] = []  # tiles and room of the renderings whose numbers are not known
        self._host: list[Tensor] = []  # those numbers, as many as were ever asked for at a time
        self._event: Any = None

    def room(self, tiles: int) -> int | None:
        """Pairs to make room for in an image of so many tiles; None = wait for the number, and ``learn`` it."""
        largest = self._largest.get(tiles)
        if self.exact or largest is None:
            return None
        return min(-(-int(SLACK * largest) // STEP) * STEP, MAX_PAIRS)

    def learn(self, tiles: int, pairs: int) -> None:
        """Take the number of pairs of a rendering, once it is known."""
        self._largest[tiles] = max(pairs, self._largest.get(tiles, 0) * (1 - FORGET))

    def ask(self, tiles: int, room: int, pairs: Tensor) -> None:
        """Keep the number of pairs [] int64 of a rendering with ``room``, to be looked at later."""
        lacks = (pairs > room).to(torch.int32)
        self.overflow = lacks if self.overflow is None else self.overflow | lacks
        if len(self._host) == len(self._asked):
            self._host.append(torch.empty((), dtype=torch.int64, pin_memory=pairs.is_cuda))
        self._host[len(self._asked)].copy_(pairs, non_blocking=True)
        self._asked.append((tiles, room))
        if pairs.is_cuda:
            self._event = self._event or torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(pairs.device))

    def overflowed(self) -> bool:
        """Whether a rendering lacked pairs; waits until their numbers are known, not until they are done."""
        asked, self._asked, self.overflow = self._asked, [], None
        if asked and self._event is not None:
            self._event.synchronize()
        numbers = [int(number.numpy()) for number in self._host[: len(asked)]]
        for (tiles, _), pairs in zip(asked, numbers, strict=True):
            self.learn(tiles, pairs)
        return any(pairs > room for (_, room), pairs in zip(asked, numbers, strict=True))


def room_for(pairs: Tensor, tiles: int, budget: PairBudget | None) -> int:
    """Room for the pairs of a rendering: their number [] int64, for which the host waits, or what the budget allows."""
    room = None if budget is None else budget.room(tiles)
    if room is None:
        room = int(pairs)  # the one wait of a rendering
        if budget is not None:
            budget.learn(tiles, room)
    elif budget is not None:
        budget.ask(tiles, room, pairs)
    return room
