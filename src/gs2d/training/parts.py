"""Where the rows of a training's splats lie: all of them here, or a part in each of several processes.

Rows have one order over all processes: those of process 0, then those of process 1, and so on. What changes rows
(``training.rows``, densifiers, entry actions) looks at its own rows, and asks ``TrainState.parts`` for what takes all
of them: numbers of rows, rankings, draws. So one code does both, and a training whose splats are sharded
(:mod:`gs2d.training.shards`) decides what one process would.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


class Whole:
    """All rows are here: what is asked of all of them is asked of these. Every process must ask the same."""

    def count(self, own: int) -> int:
        """Return a number of rows, added up over the processes."""
        return own

    def total(self, own: Tensor) -> Tensor:
        """Return sums over rows, of all processes."""
        return own

    def mean(self, own: Tensor) -> float:
        """Return the mean of numbers of rows [N]."""
        return float(own.mean())

    def whole(self, own: Tensor) -> Tensor:
        """Return numbers of rows [n] of all processes [N], in the order of rows."""
        return own

    def own(self, whole: Tensor, like: Tensor) -> Tensor:
        """Return those of all numbers of rows [N] that belong to this process, of which ``like`` [n] are as many."""
        return whole

    def normal(self, generator: torch.Generator, pieces: Sequence[int], columns: int, dtype: torch.dtype) -> Tensor:
        """Draw normal numbers [n, columns], in the host's memory, for some rows.

        ``pieces`` are the lengths of what they consist of: all first pieces, of all processes, are drawn first.
        """
        return torch.randn(sum(pieces), columns, generator=generator, dtype=dtype)

    def settle(self, state: Any, pieces: Sequence[int]) -> None:
        """Put the rows of a TrainState in their order after some went, and ``pieces`` of others were appended."""


WHOLE = Whole()
