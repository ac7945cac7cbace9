"""Writes what a prepared scene lacks: in this process, or in several where there is much to do."""

from __future__ import annotations

import os
import pickle
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from gs2d.core.memory_limit import cache_bytes
from gs2d.data.build import Decoder
from gs2d.data.prepared import Stored, Task, prepare_here
from gs2d.data.scene import View
from gs2d.errors import DataError, DiskError

MANY_PIXELS = 200_000_000  # of photographs' files, from which processes are worth the seconds that they take to start
PROCESS_BYTES = 250 << 20  # of a process by itself
PIXEL_BYTES = 60  # of a photograph's file, while its lens is taken out
PACKED = 0.7  # of the bytes of pixels that a file of a prepared photograph has, at most: 0.3 to 0.65 were met


def packed_bytes(views: Sequence[View]) -> int:
    """Return the bytes that prepared pictures of the views take on the disk, at most but for noise."""
    return int(PACKED * 3 * sum(view.camera.width * view.camera.height for view in views))


def check_disk(folder: Path, views: Sequence[View], disk: int | None) -> None:
    """Refuse to prepare what has no room on the disk, before anything is written.

    Parameters
    ----------
    folder : Path
        Where it is to be; need not be there yet.
    views : sequence of View
        Those to prepare.
    disk : int or None
        Bytes that the user allows.
    """
    there = next(place for place in (folder, *folder.resolve().parents) if place.exists())
    free, need = shutil.disk_usage(there).free, packed_bytes(views)
    room, whose = (free, f"free at {there}") if disk is None or free < disk else (disk, "that --disk allows")
    if need > room:
        raise DiskError(
            f"{len(views):,} prepared photographs need about {need / 2**30:.2g} GiB of disk, got "
            f"{room / 2**30:.2g} GiB {whose}; use a larger --downscale, another --out, or --prepare never"
        )


def prepare(views: Sequence[View], threads: int) -> Iterator[int]:
    """Prepare views of a ``prepared_scene``; yields the bytes of each file as it is done, in no order.

    Raises
    ------
    DataError
        A photograph that does not decode.
    DiskError
    """
    sizes = [view.file_intrinsics() for view in views]
    pixels = [k.width * k.height for k in sizes]
    most = cache_bytes(1 << 50) // (PROCESS_BYTES + PIXEL_BYTES * max(pixels, default=1))
    processes = min(threads, most, len(views))
    if sum(pixels) < MANY_PIXELS or processes < 2:
        yield from prepare_here(views, max(1, min(threads, 2)))
    else:
        yield from _in_processes(views, processes)


def _in_processes(views: Sequence[View], count: int) -> Iterator[int]:
    tasks = [
        Task(view.decode.original, view.decode.file, view.decode.key)
        for view in views
        if isinstance(view.decode, Stored) and isinstance(view.decode.original, Decoder)
    ]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-m", "gs2d.data.prepare_worker"]
    lines: queue.Queue[str | None] = queue.Queue()
    workers: list[subprocess.Popen[bytes]] = []
    listeners: list[threading.Thread] = []

    def listen(worker: subprocess.Popen[bytes], part: Sequence[Task]) -> None:
        assert worker.stdin is not None
        assert worker.stdout is not None
        try:
            with worker.stdin:
                worker.stdin.write(pickle.dumps(part))
        except OSError:
            pass  # it has ended: what it said, or its exit code, says why
        with worker.stdout:
            for line in worker.stdout:
                lines.put(line.decode(errors="replace").rstrip("\n"))
        if worker.wait() not in (0, 2):
            lines.put(
                f"error DataError a process that prepares photographs ended with {worker.returncode}; is there "
                "enough memory? Run the command again: it goes on"
            )
        lines.put(None)

    try:
        for number in range(count):
            worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
            workers.append(worker)
            listeners.append(threading.Thread(target=listen, args=(worker, tasks[number::count]), daemon=True))
            listeners[-1].start()
        ended = 0
        while ended < count:
            line = lines.get()
            if line is None:
                ended += 1
            elif line.startswith("error "):
                _, kind, text = line.split(" ", 2)
                raise (DiskError if kind == "DiskError" else DataError)(text)
            else:
                yield int(line)
    finally:
        for worker in workers:
            if worker.poll() is None:
                worker.terminate()
        for worker, listener in zip(workers, listeners, strict=True):
            listener.join()  # it reads to the end
            worker.wait()
