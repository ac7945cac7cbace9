"""Memory for the pairs of splat and tile of a view, without waiting for the device to count them."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gs2d.kernels.cuda.driver import fault_of

SLACK = 1.25  # room for a new view, relative to the largest count at its image size
VIEW_SLACK = 1.1  # room for a known view, relative to its last count
MAX_VIEWS = 1 << 14  # counts to keep; a learned camera is a new view each time
STEP = 1 << 16  # room is a multiple of it, so that torch's allocator sees few sizes
FORGET = 1 / 1024  # decay of the largest count per rendering: unused room is sorted too
MAX_PAIRS = (1 << 31) - 1


class Rendering(NamedTuple):
    """Key of a rendering: number of tiles, number of splats, and the camera as bytes."""

    tiles: int
    splats: int = 1
    camera: bytes = b""


class PairBudget:
    """Decides how many pairs of splat and tile a rendering of a training run has room for.

    The first rendering of an image size waits for its count of pairs; later ones do not wait. A known view gets
    VIEW_SLACK times its last count, scaled up if splats were added; views of one size differ by a factor of three. A
    new view gets SLACK times the largest count at its size, which decays slowly. If that is too little, the farthest
    pairs are dropped. ``overflow`` then reports it to the device at once, so that updates change nothing, and
    ``overflowed`` to the host later, so that the caller repeats the iteration with ``exact`` set. Both cover all
    renderings since the last call of ``overflowed``, since an iteration may render two views.
    """

    def __init__(self) -> None:
        self.exact = False  # whether the next renderings wait for their counts
        self.overflow: Tensor | None = None  # [] int32 on the device: whether one lacks pairs; None: all were exact
        self._largest: dict[int, float] = {}  # by the number of tiles
        self._of_view: dict[bytes, tuple[int, int]] = {}  # pairs, and splats at that time, by camera
        self._pending: list[tuple[Rendering, int]] = []  # renderings with unknown counts, and their room
        self._host: list[Tensor] = []  # host memory for these counts, reused
        self._event: Any = None

    def room(self, rendering: Rendering) -> int | None:
        """Return the pairs to reserve; None: wait for the count and pass it to ``learn``."""
        largest = self._largest.get(rendering.tiles)
        if self.exact or largest is None:
            return None
        last = self._of_view.get(rendering.camera)
        target = SLACK * largest
        if last is not None:
            pairs, splats = last
            target = VIEW_SLACK * pairs * max(1.0, rendering.splats / max(splats, 1))
        return min(-(-int(target) // STEP) * STEP, MAX_PAIRS)

    def learn(self, rendering: Rendering, pairs: int) -> None:
        """Record the count of pairs of a rendering."""
        tiles = rendering.tiles
        self._largest[tiles] = max(pairs, self._largest.get(tiles, 0) * (1 - FORGET))
        if rendering.camera:
            if len(self._of_view) >= MAX_VIEWS:
                self._of_view.clear()
            self._of_view[rendering.camera] = pairs, rendering.splats

    def fetch(self, rendering: Rendering, room: int, pairs: Tensor) -> None:
        """Copy the count of pairs [] int64 of a rendering with ``room`` to the host, without waiting."""
        short = (pairs > room).to(torch.int32)
        self.overflow = short if self.overflow is None else self.overflow | short
        self.expect(rendering, room, pairs.device).copy_(pairs, non_blocking=True)
        self.record(pairs.device)

    def expect(self, rendering: Rendering, room: int, device: torch.device) -> Tensor:
        """Return the host tensor [] int64 for the count of pairs of a rendering with ``room``.

        The caller writes it, sets ``overflow``, and calls :meth:`record` after queueing the write.
        """
        if len(self._host) == len(self._pending):
            self._host.append(torch.empty((), dtype=torch.int64, pin_memory=device.type == "cuda"))
        self._pending.append((rendering, room))
        return self._host[len(self._pending) - 1]

    def record(self, device: torch.device) -> None:
        """Record an event on the current stream, after which the counts are on the host."""
        if device.type == "cuda":
            self._event = self._event or torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(device))

    def overflowed(self) -> bool:
        """Whether a rendering lacked pairs; waits for the counts, not for the renderings.

        Raises BackendError if an earlier kernel failed: torch reports it here first.
        """
        pending, self._pending, self.overflow = self._pending, [], None
        if pending and self._event is not None:
            with fault_of("an iteration"):
                self._event.synchronize()
        numbers = [int(number.numpy()) for number in self._host[: len(pending)]]
        for (rendering, _), pairs in zip(pending, numbers, strict=True):
            self.learn(rendering, pairs)
        return any(pairs > room for (_, room), pairs in zip(pending, numbers, strict=True))


def room_for(pairs: Tensor, rendering: Rendering, budget: PairBudget | None) -> int:
    """Return the room for a rendering with ``pairs`` [] int64: the budget's, or the count, for which the host waits."""
    room = None if budget is None else budget.room(rendering)
    if room is None:
        with fault_of("the number of pairs of splat and tile"):
            room = int(pairs)  # the only wait of a rendering
        if budget is not None:
            budget.learn(rendering, room)
    elif budget is not None:
        budget.fetch(rendering, room, pairs)
    return room
