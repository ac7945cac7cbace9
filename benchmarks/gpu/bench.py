"""What the three commands share: the device or its emulator, clocks, the result file."""

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
from gs2d.kernels.cuda.launch import Launcher, OneByOne
from gs2d.render.backends import BACKENDS, Backend, get_backend
from gs2d.render.cuda_backend import CudaBackend

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
CLOCKS = "clocks.sm,clocks.mem,clocks.max.sm,temperature.gpu,power.draw,driver_version"


@dataclass(frozen=True, eq=False)
class Bench:
    """Where things run.

    Attributes
    ----------
    backend : Backend
        "cuda"; with ``dry`` its kernels run emulated on the CPU, at toy size, and no time means anything.
    launcher : Launcher
    dry : bool
    end : float
        By ``time.monotonic()``: no part is begun after it.
    """

    backend: Backend
    launcher: Launcher
    dry: bool
    end: float = math.inf

    def attempt(self, name: str, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """:func:`attempt`, unless the time is up: what is done by then is in the file."""
        if time.monotonic() >= self.end:
            return {"skipped": "out of time (--minutes)"}
        return attempt(name, work)

    def attempt_all(
        self,
        parts: Mapping[str, Callable[[], dict[str, Any]]],
        only: Sequence[str],
        progress: Callable[[dict[str, Any]], None],
    ) -> dict[str, Any]:
        """Return the results of the parts whose name has a word of ``only`` in it; ``progress`` sees them grow."""
        found: dict[str, Any] = {}
        for name, work in parts.items():
            if not only or any(word in name for word in only):
                found[name] = self.attempt(name, work)
                progress(found)
        return found

    def seconds_left(self, most: float) -> float:
        """Until the time is up, at most so many."""
        return max(1.0, min(most, self.end - time.monotonic()))

    @property
    def device(self) -> torch.device:
        """Where tensors belong."""
        return torch.device("cpu") if self.dry else torch.device("cuda", torch.cuda.current_device())

    def wait(self) -> None:
        """Until the device is idle."""
        if not self.dry:
            torch.cuda.synchronize()

    def times(self, work: Callable[[int], object], *, repeats: int, warmup: int) -> dict[str, float]:
        """Milliseconds of ``work(i)``, i = 0, 1, ...: median, best and interquartile distance, by events."""
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
        """Everything that looks for the device's launcher finds this one."""
        before = launch.launcher_for
        launch.launcher_for = lambda device: launcher
        try:
            yield
        finally:
            launch.launcher_for = before

    @contextmanager
    def recorded(self) -> Iterator[set[str]]:
        """The names of the kernels that are launched."""
        launcher = RecordingLauncher(self.launcher)
        with self.replaced(launcher):
            yield launcher.names

    def peak_memory(self, work: Callable[[], object]) -> int:
        """Bytes that torch's allocator held at most during ``work``, beyond those before."""
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
    """Runs from its making; ``stop`` returns what will give the milliseconds."""

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
class RecordingLauncher(OneByOne):
    """Notes the names of what another launcher launches."""

    inner: Launcher
    names: set[str] = field(default_factory=set)

    def launch(self, name: str, blocks: int, threads: int, arguments: Any, shared_bytes: int = 0) -> None:
        self.names.add(name)
        self.inner.launch(name, blocks, threads, arguments, shared_bytes)


@dataclass(eq=False)
class TimingLauncher(OneByOne):
    """Times every launch of another launcher, by kernel."""

    inner: Launcher
    dry: bool
    spans: dict[str, list[Callable[[], float]]] = field(default_factory=dict)

    def launch(self, name: str, blocks: int, threads: int, arguments: Any, shared_bytes: int = 0) -> None:
        clock = _Clock(self.dry)
        self.inner.launch(name, blocks, threads, arguments, shared_bytes)
        self.spans.setdefault(name, []).append(clock.stop())

    def medians(self, skip: int) -> dict[str, float]:
        """Milliseconds by kernel; the first ``skip`` launches of each warm up."""
        return rounded(
            {
                name: statistics.median([span() for span in (spans[skip:] or spans)])
                for name, spans in self.spans.items()
            }
        )


def kernel_times(bench: Bench, work: Callable[[], object], repeats: int) -> dict[str, float]:
    """Microseconds of each kernel in one ``work``, the most first, by torch's profiler: those in graphs, too."""
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
    """The backend "cuda" on the CPU's memory."""

    device = "cpu"


@contextmanager
def opened(dry: bool, minutes: float = math.inf) -> Iterator[Bench]:
    """The bench; with ``dry`` every launcher and the backend "cuda" are the emulator's until the end."""
    end = time.monotonic() + 60 * minutes
    if not dry:
        backend = get_backend("cuda")
        device = torch.device("cuda", torch.cuda.current_device())
        yield Bench(backend, launch.launcher_for(device), False, end)
        return
    sys.path.insert(0, str(ROOT / "tests" / "helpers"))
    from emulate import Emulator

    emulator, backend = Emulator(), EmulatedBackend()
    before = launch.launcher_for, BACKENDS._things["cuda"]
    launch.launcher_for = lambda device: emulator
    BACKENDS._things["cuda"] = lambda: backend
    try:
        yield Bench(backend, emulator, True, end)
    finally:
        launch.launcher_for, BACKENDS._things["cuda"] = before


def facts(bench: Bench) -> dict[str, Any]:
    """What the numbers were measured on, and with which versions."""
    found: dict[str, Any] = {**machine(), "dry_run": bench.dry}
    if bench.dry:
        return found
    properties = torch.cuda.get_device_properties(bench.device)
    found["gpu"] = {
        "name": properties.name,
        "multiprocessors": properties.multi_processor_count,
        "memory_bytes": properties.total_memory,
        "l2_bytes": getattr(properties, "L2_cache_size", None),
        "details": diagnose.describe(diagnose.gather()),
        "torch_cuda": torch.version.cuda,
    }
    found["clocks"] = clocks()
    return found


def clocks() -> dict[str, str] | str:
    """Clocks, temperature and power now; or why they are not known."""
    device = torch.cuda.current_device()
    known = getattr(torch.cuda.get_device_properties(device), "uuid", None)  # its numbers ignore CUDA_VISIBLE_DEVICES
    which = str(device) if known is None else f"GPU-{known}"
    command = ["nvidia-smi", f"--query-gpu={CLOCKS}", "--format=csv,noheader", "-i", which]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        return f"not known: {error}"
    return dict(zip(CLOCKS.split(","), (word.strip() for word in done.stdout.split(",")), strict=False))


def commit() -> str:
    """The checkout that was measured; of a copy without history what ``GS2D_COMMIT`` says."""
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
    """A program that ended, or was ended: ``exit`` is None where its time was up. Output and errors in one."""

    exit: int | None
    lines: list[str]


def run_program(command: Sequence[str], *, seconds: float, environment: Mapping[str, str] | None = None) -> Finished:
    """Run a program in the checkout; when its time is up it ends with all it has started, and what it said is kept."""
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
    """Numbers as a result file holds them."""
    return {name: round(value, digits) for name, value in values.items()}


def attempt(name: str, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The result of ``work``, or what stopped it: one failing part must not lose the others of an expensive run."""
    try:
        return work()
    except Exception as error:
        text = (str(error).strip().splitlines() or [""])[0]
        print(f"{name}: {type(error).__name__}: {text}", file=sys.stderr)
        return {"failed": f"{type(error).__name__}: {text}"}


def write(path: Path, document: dict[str, Any]) -> None:
    """The result file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(document, indent=1, sort_keys=False) + "\n")
    temporary.rename(path)
