"""Room for the pairs of a view without asking the device for their number."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gs2d.kernels.cuda.driver import fault_of

__all__ = ["MAX_PAIRS", "PairBudget", "Rendering", "room_for"]

SLACK = 1.25  # room of a view that was not rendered before, in the largest number of its size
VIEW_SLACK = 1.1  # of one that was, in its last number
MAX_VIEWS = 1 << 14  # numbers that are kept: cameras that are learned are new ones each time
STEP = 1 << 16  # room is a multiple of it, so that torch's allocator sees few sizes
FORGET = 1 / 1024  # share of the largest number that goes with each rendering: room that is not used is sorted too
MAX_PAIRS = (1 << 31) - 1


class Rendering(NamedTuple):
    """What is rendered: tiles of the image, how many splats, and the camera in bytes."""

    tiles: int
    splats: int = 1
    camera: bytes = b""


class PairBudget:
    """How much room the renderings of a training run make for pairs of splat and tile.

    The first rendering of a size waits for the number of pairs; later ones wait for nothing. A view that was rendered
    before takes VIEW_SLACK times its last number, and more where splats were added since: views of one size differ by
    a factor of three. Another view takes SLACK times the largest number of its size so far, which is slowly forgotten.
    If that is too little, the pairs farthest away are left out, which ``overflow`` says on the device at once, and
    ``overflowed`` on the host afterwards. So an update that reads ``overflow`` does nothing, and the caller renders
    again with ``exact`` set. Both speak of all renderings since the last ``overflowed``: an iteration may render two
    views.

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
        self._of_view: dict[bytes, tuple[int, int]] = {}  # pairs, and splats at that time, by camera
        self._asked: list[tuple[Rendering, int]] = []  # renderings whose numbers are not known, and their room
        self._host: list[Tensor] = []  # those numbers, as many as were ever asked for at a time
        self._event: Any = None

    def room(self, rendering: Rendering) -> int | None:
        """Pairs to make room for; None = wait for their number, and ``learn`` it."""
        largest = self._largest.get(rendering.tiles)
        if self.exact or largest is None:
            return None
        known = self._of_view.get(rendering.camera)
        wanted = SLACK * largest
        if known is not None:
            pairs, splats = known
            wanted = VIEW_SLACK * pairs * max(1.0, rendering.splats / max(splats, 1))
        return min(-(-int(wanted) // STEP) * STEP, MAX_PAIRS)

    def learn(self, rendering: Rendering, pairs: int) -> None:
        """Take the number of pairs of a rendering, once it is known."""
        tiles = rendering.tiles
        self._largest[tiles] = max(pairs, self._largest.get(tiles, 0) * (1 - FORGET))
        if rendering.camera:
            if len(self._of_view) >= MAX_VIEWS:
                self._of_view.clear()
            self._of_view[rendering.camera] = pairs, rendering.splats

    def ask(self, rendering: Rendering, room: int, pairs: Tensor) -> None:
        """Keep the number of pairs [] int64 of a rendering with ``room``, to be looked at later."""
        lacks = (pairs > room).to(torch.int32)
        self.overflow = lacks if self.overflow is None else self.overflow | lacks
        self.expect(rendering, room, pairs.device).copy_(pairs, non_blocking=True)
        self.asked(pairs.device)

    def expect(self, rendering: Rendering, room: int, device: torch.device) -> Tensor:
        """Return where the number of pairs of a rendering with ``room`` is to be written, [] int64: the host's memory.

        What writes it sets ``overflow`` too, and says when it is on its way (:meth:`asked`).
        """
        if len(self._host) == len(self._asked):
            self._host.append(torch.empty((), dtype=torch.int64, pin_memory=device.type == "cuda"))
        self._asked.append((rendering, room))
        return self._host[len(self._asked) - 1]

    def asked(self, device: torch.device) -> None:
        """Remember the moment, on the current stream, from which the numbers are there."""
        if device.type == "cuda":
            self._event = self._event or torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(device))

    def overflowed(self) -> bool:
        """Whether a rendering lacked pairs; waits until their numbers are known, not until they are done.

        Raises
        ------
        BackendError
            An error that a kernel has left behind: torch meets it first here.
        """
        asked, self._asked, self.overflow = self._asked, [], None
        if asked and self._event is not None:
            with fault_of("an iteration"):
                self._event.synchronize()
        numbers = [int(number.numpy()) for number in self._host[: len(asked)]]
        for (rendering, _), pairs in zip(asked, numbers, strict=True):
            self.learn(rendering, pairs)
        return any(pairs > room for (_, room), pairs in zip(asked, numbers, strict=True))


def room_for(pairs: Tensor, rendering: Rendering, budget: PairBudget | None) -> int:
    """Room for the pairs of a rendering: their number [] int64, for which the host waits, or what the budget allows."""
    room = None if budget is None else budget.room(rendering)
    if room is None:
        with fault_of("the number of pairs of splat and tile"):
            room = int(pairs)  # the one wait of a rendering
        if budget is not None:
            budget.learn(rendering, room)
    elif budget is not None:
        budget.ask(rendering, room, pairs)
    return room
