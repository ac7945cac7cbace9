"""The memory limit of this process: the smallest of control group, address space, machine and ``--memory``.

Beyond the limit of a control group the process is killed without a MemoryError. Therefore caches are sized by the
limit, and work that cannot fit is refused before it begins.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

CACHE_FRACTION = 0.2  # of the free memory, for a cache
BUDGET_FRACTION = 0.5  # of the limit, default budget of a command
_UNLIMITED = 1 << 60  # cgroup v1 reports about 2^63 for no limit


@dataclass(frozen=True)
class MemoryLimit:
    """A memory limit and its use by this process."""

    bytes: int
    used: int  # bytes
    source: str  # description of the limit

    @property
    def room(self) -> int:
        """Free bytes."""
        return max(self.bytes - self.used, 0)


def memory_limit(root: Path = Path("/")) -> MemoryLimit | None:
    """Return the limit with the least free memory: cgroup (v1, v2), RLIMIT_AS, machine, ``--memory``; None if unknown.

    ``root`` is the folder of ``proc`` and ``sys``.
    """
    mapped, resident = _own_pages(root)
    limits = [MemoryLimit(limit, resident, source) for limit, source in (*_cgroups(root), *_physical(root))]
    addresses = address_space()
    if addresses is not None:
        limits.append(MemoryLimit(addresses, mapped, "the limit on address space, ulimit -v"))
    limits += [MemoryLimit(budget, resident, "--memory") for budget in _budget]
    return min(limits, key=lambda limit: limit.room, default=None)


_budget: list[int] = []  # at most one value: the limit set by the user


def set_memory_budget(budget: int | None) -> None:
    """Set the memory budget of this process, bytes; None: no budget."""
    _budget[:] = [] if budget is None else [budget]


def memory_budget() -> int | None:
    """Return the budget in bytes: as set, else half of the limit; None if unknown."""
    if _budget:
        return _budget[0]
    limit = memory_limit()
    return None if limit is None else int(BUDGET_FRACTION * limit.bytes)


def cache_bytes(requested: int) -> int:
    """Return the size of a cache in bytes: ``requested``, or less if memory is limited."""
    limit = memory_limit()
    return requested if limit is None else min(requested, int(CACHE_FRACTION * limit.room))


def _own_pages(root: Path) -> tuple[int, int]:
    """Return address space and resident memory of this process, bytes."""
    try:
        fields = (root / "proc/self/statm").read_text().split()
        page = os.sysconf("SC_PAGE_SIZE")
        return int(fields[0]) * page, int(fields[1]) * page
    except (OSError, ValueError, IndexError):
        return 0, 0


def _cgroups(root: Path) -> Iterator[tuple[int, str]]:
    """Yield the limits of the control groups of this process and of their ancestors."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if number == "0" and not controllers:
            mount, name, words = root / "sys/fs/cgroup", "memory.max", "the control group (memory.max)"
        elif "memory" in controllers.split(","):
            mount, name = root / "sys/fs/cgroup/memory", "memory.limit_in_bytes"
            words = "the control group (memory.limit_in_bytes)"
        else:
            continue
        parts = [part for part in path.split("/") if part not in ("", "..", ".")]
        for depth in range(len(parts), -1, -1):  # in a container, the path may be that of the host
            try:
                limit = int((mount.joinpath(*parts[:depth]) / name).read_text())
            except (OSError, ValueError):  # missing, or "max"
                continue
            if 0 < limit < _UNLIMITED:
                yield limit, words


def _physical(root: Path) -> Iterator[tuple[int, str]]:
    try:
        for line in (root / "proc/meminfo").read_text().splitlines():
            if line.startswith("MemTotal:"):
                yield int(line.split()[1]) * 1024, "the memory of this machine"
                return
    except (OSError, ValueError, IndexError):
        pass
    try:
        yield os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"), "the memory of this machine"
    except (OSError, ValueError, AttributeError):
        return


def address_space() -> int | None:
    """Return the limit on address space (RLIMIT_AS), bytes; None without one."""
    try:
        import resource  # not on Windows
    except ImportError:
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit
