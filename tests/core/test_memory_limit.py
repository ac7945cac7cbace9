"""Memory limits and cache sizes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gs2d.core.memory_limit import memory_limit

MB = 1 << 20


def machine(root: Path, groups: str, files: dict[str, str], total: int = 16 << 30) -> Path:
    """``proc`` and ``sys`` of a machine with 16 GiB, where this process has 100 MB."""
    (root / "proc/self").mkdir(parents=True)
    page = os.sysconf("SC_PAGE_SIZE")
    (root / "proc/self/statm").write_text(f"{900 * MB // page} {100 * MB // page} 0 0 0 0 0\n")
    (root / "proc/self/cgroup").write_text(groups)
    (root / "proc/meminfo").write_text(f"MemTotal:       {total // 1024} kB\nMemFree: 1 kB\n")
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


@pytest.mark.parametrize(
    ("groups", "files", "expected", "word"),
    [
        ("0::/\n", {"sys/fs/cgroup/memory.max": f"{1300 * MB}\n"}, 1300, "memory.max"),
        (
            "0::/a/b\n",
            {"sys/fs/cgroup/a/b/memory.max": "max\n", "sys/fs/cgroup/a/memory.max": f"{700 * MB}"},
            700,
            "max",
        ),
        ("0::/host/only\n", {"sys/fs/cgroup/memory.max": f"{500 * MB}"}, 500, "memory.max"),  # in a container
        (
            "5:cpu:/x\n4:memory:/docker/1\n",
            {"sys/fs/cgroup/memory/docker/1/memory.limit_in_bytes": f"{600 * MB}\n"},
            600,
            "limit_in_bytes",
        ),
        ("4:memory:/\n", {"sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712\n"}, 16 * 1024, "machine"),
        ("0::/\n", {"sys/fs/cgroup/memory.max": "max\n"}, 16 * 1024, "machine"),
        ("nonsense\n", {"sys/fs/cgroup/memory.max": "nonsense"}, 16 * 1024, "machine"),
    ],
)
def test_the_smallest_limit_is_used(
    tmp_path: Path, groups: str, files: dict[str, str], expected: int, word: str
) -> None:
    limit = memory_limit(machine(tmp_path, groups, files))
    assert limit is not None
    assert limit.bytes == expected * MB
    assert limit.used == pytest.approx(100 * MB, abs=1 << 16)
    assert limit.room == pytest.approx((expected - 100) * MB, abs=1 << 16)
    assert word in limit.source


def test_a_real_limit_is_detected() -> None:
    code = (
        "import resource; resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))\n"
        "from gs2d.core.memory_limit import memory_limit, cache_bytes\n"
        "limit = memory_limit(); print(limit.bytes, limit.source, 0 < cache_bytes(4 << 30) < 1 << 28)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split()[0] == str(1 << 30), done.stderr
    assert "ulimit -v" in done.stdout
    assert done.stdout.split()[-1] == "True"
