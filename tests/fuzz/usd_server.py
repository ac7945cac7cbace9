"""Read OpenUSD as gs2d does, a process with limits for each file, without starting Python and OpenUSD each time.

A server has loaded ``usd_process`` and OpenUSD and has read a good file; each file is read by a fork of it, which sets
its own limits and ends, by a signal perhaps, as the process that gs2d starts does. ``python usd_server.py PROCESS
GOOD`` answers lines of JSON on stdin, ``[path, bytes, seconds]``, by ``[status, length]`` and what was written.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib.util
import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any


class Server:
    """Stands for ``gs2d.contrib.formats.usd._read_apart``."""

    def __init__(self, process: str, good: bytes, wait: int) -> None:
        self._wait = wait
        limited = {"PXR_WORK_THREAD_LIMIT": "1", "MALLOC_ARENA_MAX": "1", "OPENBLAS_NUM_THREADS": "1"}
        with TemporaryDirectory(prefix="gs2d-usd-") as home:
            path = Path(home, "a.usda")
            path.write_bytes(good)
            words = [sys.executable, "-P", __file__, process, str(path)]
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            self._server = subprocess.Popen(words, env={**os.environ, **limited}, **pipes)  # type: ignore[call-overload]
            atexit.register(self.close)
            if self._server.stdout.readline() != b"ready\n":
                raise RuntimeError("the server of OpenUSD did not start")

    def close(self) -> None:
        """Let the server end."""
        self._server.stdin.close()
        self._server.wait()
        self._server.stdout.close()

    def read(self, path: str, most: int, seconds: int) -> tuple[int, bytes]:
        """Return status and output of a process that reads the file."""
        self._server.stdin.write(json.dumps([path, most, seconds, self._wait * seconds]).encode() + b"\n")
        self._server.stdin.flush()
        status, length = json.loads(self._server.stdout.readline())
        said = self._server.stdout.read(length)
        if status is None:
            raise subprocess.TimeoutExpired(path, self._wait * seconds)
        return status, said


def _answer(module: Any, path: str, most: int, seconds: int, wait: float) -> tuple[int | None, bytes]:
    """Read in a fork; None for its status where it was late."""
    out, into = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.dup2(into, 1), os.close(out), os.close(into)
            module.main(path, str(most), str(seconds))
        finally:
            os._exit(1)  # as Python ends after an exception
    os.close(into)
    said, end = b"", time.monotonic() + wait
    while select.select([out], [], [], max(0.0, end - time.monotonic()))[0]:
        block = os.read(out, 1 << 20)
        said += block
        if not block:
            break
    else:
        os.kill(child, signal.SIGKILL)
    os.close(out)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return (None if time.monotonic() > end else code), said


def main(process: str, good: str) -> None:
    """Serve until stdin ends."""
    spec = importlib.util.spec_from_file_location("usd_process", process)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module._found(good)
    sys.stdout.buffer.write(b"ready\n")
    sys.stdout.buffer.flush()
    for line in sys.stdin.buffer:
        status, said = _answer(module, *json.loads(line))
        with contextlib.suppress(BrokenPipeError):
            sys.stdout.buffer.write(json.dumps([status, len(said)]).encode() + b"\n" + said)
            sys.stdout.buffer.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
