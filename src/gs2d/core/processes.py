"""Which of the processes of a training this one is, as ``torchrun`` says in the environment. Never imports torch."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

from gs2d.errors import BackendError

NEEDED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")  # without one of them nobody can be met


@dataclass(frozen=True)
class Place:
    """The place of this process among those that train together.

    Attributes
    ----------
    rank : int
        From 0, over all machines. Process 0 leads: it alone writes and prints.
    size : int
        Processes in all.
    local_rank, local_size : int
        The same on this machine; the GPU is chosen by the first.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this is process 0."""
        return self.rank == 0


def here(environment: Mapping[str, str] = os.environ) -> Place:
    """Return the place of this process; that of the only one where nothing, or not all, of it is said.

    Raises
    ------
    BackendError
        What is said cannot be.
    """
    if not all(environment.get(name) for name in NEEDED):
        return Place()
    said = {name: environment[name] for name in ("RANK", "WORLD_SIZE")}
    said["LOCAL_RANK"] = environment.get("LOCAL_RANK") or said["RANK"]
    said["LOCAL_WORLD_SIZE"] = environment.get("LOCAL_WORLD_SIZE") or said["WORLD_SIZE"]
    try:
        place = Place(*map(int, said.values()))
    except ValueError:
        place = Place(-1)
    if not (0 <= place.rank < place.size and 0 <= place.local_rank < place.local_size <= place.size):
        shown = ", ".join(f"{name}={value}" for name, value in said.items())
        raise BackendError(
            f"the environment must say which process this is as torchrun does, got {shown}; start with torchrun, or "
            "unset WORLD_SIZE"
        )
    return place
