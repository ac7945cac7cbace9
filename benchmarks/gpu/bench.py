"""Shared parts of the GPU commands: the device or its emulator, clocks, and the result file."""

from __future__ import annotations

import json
import math
import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from benchmarks.timing import machine
from gs2d.kernels.cuda import diagnose, launch
from gs2d.kernels.cuda.launch import Launcher
from gs2d.render.backends import BACKENDS, Backend, get_backend
from gs2d.render.cuda_backend import CudaBackend

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
CLOCKS = "clocks.sm,clocks.mem,clocks.max.sm,temperature.gpu,power.draw,driver_version"


@dataclass(frozen=True, eq=False)
class Bench:
    """Execution environment of the measurements.

    Attributes
    ----------
    backend : Backend
        "cuda". With ``dry``, its kernels are emulated on the CPU at toy size and times are meaningless.
    launcher : Launcher
    dry : bool
    end : float
        Deadline by ``time.monotonic()``: no part starts after it.
    """

    backend: Backend
    launcher: Launcher
    dry: bool
    end: float = math.inf

    def attempt(self, name: str, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Run :func:`attempt` unless the time is up; finished parts are already in the file."""
        if time.monotonic() >= self.end:
            return {"skipped": "out of time (--minutes)"}
        return attempt(name, work)

    def attempt_all(
        self,
        parts: Mapping[str, Callable[[], dict[str, Any]]],
        only: Sequence[str],
        progress: Callable[[dict[str, Any]], None],
    ) -> dict[str, Any]:
        """Return the results of the parts whose name contains a word of ``only``; ``progress`` gets each intermediate
        result.
        """
        found: dict[str, Any] = {}
        for name, work in parts.items():
            if not only or any(word in name for word in only):
                found[name] = self.attempt(name, work)
                progress(found)
        return found

    def seconds_left(self, most: float) -> float:
        """Return the seconds until the deadline, at most this many."""
        return max(1.0, min(most, self.end - time.monotonic()))

    @property
    def device(self) -> torch.device:
        """Return the device of the tensors."""
        return torch.device("cpu") if self.dry else torch.device("cuda", torch.cuda.current_device())

    def wait(self) -> None:
        """Wait until the device is idle."""
        if not self.dry:
            torch.cuda.synchronize()

    def times(self, work: Callable[[int], object], *, repeats: int, warmup: int) -> dict[str, float]:
        """Time ``work(i)``, i = 0, 1, ..., with events: median, best and interquartile range, milliseconds."""
        if self.dry:
            repeats, warmup = 2, 0
        for i in range(warmup):
            work(i)
        values = []
        for i in range(repeats):
            clock = _Clock(self.dry)
            work(warmup + i)
            values.append(clock.stop())
        found = [value() for value in values]
        quartiles = statistics.quantiles(found, n=4)
        return rounded({"median": quartiles[1], "best": min(found), "spread": quartiles[2] - quartiles[0]})

    @contextmanager
    def replaced(self, launcher: Launcher) -> Iterator[None]:
        """Replace the launcher for all code that looks up the device's launcher."""
        before = launch.launcher_for
        launch.launcher_for = lambda device: launcher
        try:
            yield
        finally:
            launch.launcher_for = before

    @contextmanager
    def recorded(self) -> Iterator[set[str]]:
        """Record the names of launched kernels."""
        launcher = RecordingLauncher(self.launcher)
        with self.replaced(launcher):
            yield launcher.names

    def peak_memory(self, work: Callable[[], object]) -> int:
        """Return the peak memory of ``work``, bytes, in torch's allocator, beyond the memory held at the start."""
        if self.dry:
            work()
            return 0
        self.wait()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        work()
        self.wait()
        return int(torch.cuda.max_memory_allocated() - before)


class _Clock:
    """Clock that starts when created; ``stop`` returns a function for the milliseconds."""

    def __init__(self, dry: bool) -> None:
        self._start = time.perf_counter()
        self._events = None if dry else [torch.cuda.Event(enable_timing=True) for _ in range(2)]
        if self._events is not None:
            self._events[0].record()

    def stop(self) -> Callable[[], float]:
        if self._events is None:
            passed = 1e3 * (time.perf_counter() - self._start)
            return lambda: passed
        first, last = self._events
        last.record()

        def read() -> float:
            last.synchronize()
            return float(first.elapsed_time(last))

        return read


@dataclass(eq=False)
class RecordingLauncher(Launcher):
    """Launcher that records the kernel names and forwards to another launcher."""

    inner: Launcher
    names: set[str] = field(default_factory=set)

    def launch(self, name: str, blocks: int, threads: int, arguments: Any) -> None:
        self.names.add(name)
        self.inner.launch(name, blocks, threads, arguments)


@dataclass(eq=False)
class TimingLauncher(Launcher):
    """Launcher that times every launch of another launcher by kernel."""

    inner: Launcher
    dry: bool
    spans: dict[str, list[Callable[[], float]]] = field(default_factory=dict)

    def launch(self, name: str, blocks: int, threads: int, arguments: Any) -> None:
        clock = _Clock(self.dry)
        self.inner.launch(name, blocks, threads, arguments)
        self.spans.setdefault(name, []).append(clock.stop())

    def medians(self, skip: int) -> dict[str, float]:
        """Return the median milliseconds by kernel, without the first ``skip`` launches of each."""
        return rounded(
            {
                name: statistics.median([span() for span in (spans[skip:] or spans)])
                for name, spans in self.spans.items()
            }
        )


def kernel_times(bench: Bench, work: Callable[[], object], repeats: int) -> dict[str, float]:
    """Return microseconds per kernel in one ``work``, largest first, by torch's profiler, including graphs."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for _ in range(repeats):
            work()
        bench.wait()
    spans: dict[str, float] = {}
    for event in profile.events() or ():
        if event.device_type == torch.autograd.DeviceType.CUDA:
            name = event.name[:60]
            spans[name] = spans.get(name, 0.0) + event.time_range.elapsed_us() / repeats
    return rounded(dict(sorted(spans.items(), key=lambda item: -item[1])), 1)


class EmulatedBackend(CudaBackend):
    """Backend "cuda" in CPU memory."""

    device = "cpu"


@contextmanager
def opened(dry: bool, minutes: float = math.inf) -> Iterator[Bench]:
    """Yield the bench; with ``dry``, all launchers and the backend "cuda" are emulated until it closes."""
    end = time.monotonic() + 60 * minutes
    if not dry:
        backend = get_backend("cuda")
        device = torch.device("cuda", torch.cuda.current_device())
        yield Bench(backend, launch.launcher_for(device), False, end)
        return
    sys.path.insert(0, str(ROOT / "tests" / "helpers"))
    from emulate import Emulator

    emulator, backend = Emulator(), EmulatedBackend()
    before = launch.launcher_for, BACKENDS._objects["cuda"]
    launch.launcher_for = lambda device: emulator
    BACKENDS._objects["cuda"] = lambda: backend
    try:
        yield Bench(backend, emulator, True, end)
    finally:
        launch.launcher_for, BACKENDS._objects["cuda"] = before


def facts(bench: Bench) -> dict[str, Any]:
    """Return the machine and the versions of the measurement."""
    found: dict[str, Any] = {**machine(), "dry_run": bench.dry}
    if bench.dry:
        return found
    properties = torch.cuda.get_device_properties(bench.device)
    found["gpu"] = {
        "name": properties.name,
        "multiprocessors": properties.multi_processor_count,
        "memory_bytes": properties.total_memory,
        "l2_bytes": getattr(properties, "L2_cache_size", None),
        "details": diagnose.machine(),
        "torch_cuda": torch.version.cuda,
    }
    found["clocks"] = clocks()
    return found


def clocks() -> dict[str, str] | str:
    """Return current clocks, temperature and power, or why they are unknown."""
    device = torch.cuda.current_device()
    known = getattr(torch.cuda.get_device_properties(device), "uuid", None)  # nvidia-smi ignores CUDA_VISIBLE_DEVICES
    which = str(device) if known is None else f"GPU-{known}"
    command = ["nvidia-smi", f"--query-gpu={CLOCKS}", "--format=csv,noheader", "-i", which]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        return f"not known: {error}"
    return dict(zip(CLOCKS.split(","), (word.strip() for word in done.stdout.split(",")), strict=False))


def commit() -> str:
    """Return the measured commit; for a copy without history, the value of ``GS2D_COMMIT``."""
    given = os.environ.get("GS2D_COMMIT")
    if given:
        return given
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        return f"not known: {error}"
    return done.stdout.strip() or "not a git checkout"


@dataclass(frozen=True)
class Finished:
    """Finished program. ``exit`` is None if it was stopped at the deadline; output and errors are merged."""

    exit: int | None
    lines: list[str]


def run_program(command: Sequence[str], *, seconds: float, environment: Mapping[str, str] | None = None) -> Finished:
    """Run a program in the checkout; at the deadline, stop it and its children and keep its output."""
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        env={**os.environ, "PYTHONUNBUFFERED": "1", **(environment or {})},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=seconds)
        return Finished(process.returncode, output.strip().splitlines())
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        output, _ = process.communicate()
        return Finished(None, output.strip().splitlines())
    except BaseException:
        os.killpg(process.pid, signal.SIGKILL)
        raise


def rounded(values: dict[str, float], digits: int = 4) -> dict[str, float]:
    """Round numbers for a result file."""
    return {name: round(value, digits) for name, value in values.items()}


def attempt(name: str, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the result of ``work``, or its error: one failing part must not lose the others of an expensive run."""
    try:
        return work()
    except Exception as error:
        text = (str(error).strip().splitlines() or [""])[0]
        print(f"{name}: {type(error).__name__}: {text}", file=sys.stderr)
        return {"failed": f"{type(error).__name__}: {text}"}


def write(path: Path, document: dict[str, Any]) -> None:
    """Write the result file atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(document, indent=1, sort_keys=False) + "\n")
    temporary.rename(path)
