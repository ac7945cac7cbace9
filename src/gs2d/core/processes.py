"""Cores of this process, and its rank in a distributed training (the environment of ``torchrun``). No torch."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

from gs2d.errors import BackendError

NEEDED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


@dataclass(frozen=True)
class ProcessRank:
    """Rank of this process among those that train together; the local rank on this machine selects the GPU."""

    rank: int = 0  # over all machines, from 0; only rank 0 writes and prints
    size: int = 1  # number of processes
    local_rank: int = 0
    local_size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this is rank 0."""
        return self.rank == 0


def available_cores() -> int:
    """Return the CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def process_rank(environment: Mapping[str, str] = os.environ) -> ProcessRank:
    """Return the rank of this process; that of a single process if the environment is not complete.

    Raises BackendError if the environment is contradictory.
    """
    if not all(environment.get(name) for name in NEEDED):
        return ProcessRank()
    variables = {name: environment[name] for name in ("RANK", "WORLD_SIZE")}
    variables["LOCAL_RANK"] = environment.get("LOCAL_RANK") or variables["RANK"]
    variables["LOCAL_WORLD_SIZE"] = environment.get("LOCAL_WORLD_SIZE") or variables["WORLD_SIZE"]
    try:
        place = ProcessRank(*map(int, variables.values()))
    except ValueError:
        place = ProcessRank(-1)
    if not (0 <= place.rank < place.size and 0 <= place.local_rank < place.local_size <= place.size):
        shown = ", ".join(f"{name}={value}" for name, value in variables.items())
        raise BackendError(f"the environment has an invalid rank, {shown}; start with torchrun, or unset WORLD_SIZE")
    return place
