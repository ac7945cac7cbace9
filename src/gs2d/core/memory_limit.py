"""How much memory this process may have: the least of what the kernel, the container and the machine set.

What is beyond a cgroup's limit is no MemoryError but the end of the process by SIGKILL, without a word. So caches are
made as large as fits under the limit that is in force, and work that cannot fit is refused before it begins.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gs2d.errors import BackendError

__all__ = [
    "MemoryLimit",
    "address_space",
    "cache_bytes",
    "check_address_space",
    "memory_budget",
    "memory_limit",
    "set_memory_budget",
]

CACHE_FRACTION = 0.2  # of what is left, that a cache may take: what the work itself needs must fit beside it
BUDGET_FRACTION = 0.5  # of the limit in force, that a command takes if nobody says how much
LEAST_ADDRESSES = 1 << 30  # bytes of address space that Python, numpy, scipy and torch take to be loaded
THREAD_ADDRESSES = 80 << 20  # and for each more thread of OpenBLAS, of which numpy and scipy have one each
_UNLIMITED = 1 << 60  # cgroup v1 says 2^63 less a page where there is no limit


@dataclass(frozen=True)
class MemoryLimit:
    """A limit, and what of it this process has already.

    Attributes
    ----------
    bytes : int
    used : int
        Bytes of it that this process has.
    source : str
        Who sets it, in words.
    """

    bytes: int
    used: int
    source: str

    @property
    def room(self) -> int:
        """Bytes that are left."""
        return max(self.bytes - self.used, 0)


def memory_limit(root: Path = Path("/")) -> MemoryLimit | None:
    """Return the limit that leaves the least, of cgroup (v1 and v2), RLIMIT_AS, the machine and the user.

    None: none is known.

    Parameters
    ----------
    root : path
        Where ``proc`` and ``sys`` are.
    """
    mapped, resident = _own_pages(root)
    found = [MemoryLimit(limit, resident, source) for limit, source in (*_cgroups(root), *_physical(root))]
    addresses = address_space()
    if addresses is not None:
        found.append(MemoryLimit(addresses, mapped, "the limit on address space, ulimit -v"))
    found += [MemoryLimit(budget, resident, "--memory") for budget in _budget]
    return min(found, key=lambda limit: limit.room, default=None)


_budget: list[int] = []  # of this process: what the user allows it, if anything


def set_memory_budget(budget: int | None) -> None:
    """Let this process have so many bytes, or (None) as many as the kernel, the container and the machine leave."""
    _budget[:] = [] if budget is None else [budget]


def memory_budget() -> int | None:
    """Return the bytes that this process is to keep to: what was set, or half of the limit; None: none is known."""
    if _budget:
        return _budget[0]
    limit = memory_limit()
    return None if limit is None else int(BUDGET_FRACTION * limit.bytes)


def cache_bytes(wanted: int) -> int:
    """Return the bytes that a cache may take: ``wanted``, or less where memory is limited."""
    limit = memory_limit()
    return wanted if limit is None else min(wanted, int(CACHE_FRACTION * limit.room))


def check_address_space() -> None:
    """Refuse to go on where so little address space is allowed that the libraries cannot be loaded.

    Looked at before they are: OpenBLAS asks for its buffers again and again for ever if it gets none, and C++ ends the
    process. Python's package for CUDA takes more, and says so itself.
    """
    limit = address_space()
    needed = LEAST_ADDRESSES + THREAD_ADDRESSES * (_blas_threads() - 1)
    if limit is not None and limit < needed:
        raise BackendError(
            f"at least {needed / 2**30:.2f} GiB of address space are needed, got a limit of {limit / 2**30:.2f} GiB; "
            "raise it (ulimit -v unlimited), and limit memory by a control group instead"
        )


def _blas_threads() -> int:
    """Return the threads that OpenBLAS makes when it is loaded."""
    for name in ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS"):
        if (value := os.environ.get(name, "")).isdecimal() and int(value[:6]):
            return int(value[:6])
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _own_pages(root: Path) -> tuple[int, int]:
    """Bytes of this process: its address space, and what of it is in memory."""
    try:
        fields = (root / "proc/self/statm").read_text().split()
        page = os.sysconf("SC_PAGE_SIZE")
        return int(fields[0]) * page, int(fields[1]) * page
    except (OSError, ValueError, IndexError):
        return 0, 0


def _cgroups(root: Path) -> Iterator[tuple[int, str]]:
    """Yield the limits of the control groups that this process is in, and of those that these are in."""
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
        for depth in range(len(parts), -1, -1):  # in a container the path may be that of the host: what is there counts
            try:
                limit = int((mount.joinpath(*parts[:depth]) / name).read_text())
            except (OSError, ValueError):  # not there, or "max"
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
    """Return the limit on address space (RLIMIT_AS), bytes; None: there is none."""
    try:
        import resource  # not on Windows
    except ImportError:
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit
