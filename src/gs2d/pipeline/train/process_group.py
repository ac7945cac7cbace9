"""One training in several processes, as ``torchrun`` starts them: process 0 is the command, the others follow it.

Process 0 reads, decides, prints and writes as if it were alone. The others read the same capture, train along and end
with the last iteration: they write nothing, and say nothing but why they fail.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch

from gs2d.core.memory_limit import memory_limit
from gs2d.core.processes import Place, here
from gs2d.errors import BackendError, Gs2dError, RunError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.prepare.loaded import LoadedRun, prepare_run
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.interruption import HeldSignals
from gs2d.pipeline.train.run_logger import progress_every
from gs2d.training.events import Notice, OnEvent, ignore
from gs2d.training.parallel import ONE_PROCESS, LostContactError, ManyProcesses, OneProcess
from gs2d.training.trainer import Trainer, TrainerOptions

PATIENCE = timedelta(days=7)  # the others wait while process 0 scores; who is gone is noticed by its connection
GIB = 2**30


@contextmanager
def connected(backend: str) -> Iterator[OneProcess]:
    """Meet the other processes, if the environment says that there are any.

    Parameters
    ----------
    backend : str
        As it was asked for: each process of a machine takes a GPU of its own, unless it is of the CPU.

    Raises
    ------
    BackendError
        If a process has no GPU, or torch was built without ``torch.distributed``.
    """
    place = here()
    if place.size == 1:
        yield ONE_PROCESS
        return
    together = _connect(place, backend)
    try:
        yield together
    except LostContactError:
        raise
    except Exception as error:
        if not together.announce():
            raise LostContactError(str(error), told=True) from error
        if isinstance(error, Gs2dError) and not place.leads:
            error.args = (f"process {place.rank} of {place.size}: {error}", *error.args[1:])
        raise
    gc.collect()  # work that cycles keep would end with the interpreter, on threads of gloo, which then abort
    torch.distributed.destroy_process_group()


def _connect(place: Place, backend: str) -> ManyProcesses:
    """Join the group of all processes."""
    if not torch.distributed.is_available():
        raise BackendError("several processes need torch.distributed, which this torch is built without; use one")
    on_gpu = backend not in ("cpu", "reference") and torch.cuda.is_available()
    if on_gpu:
        _take_gpu(place)
    both = on_gpu and torch.distributed.is_nccl_available()
    torch.distributed.init_process_group("cpu:gloo,cuda:nccl" if both else "gloo", timeout=PATIENCE)
    return ManyProcesses(place)


def _take_gpu(place: Place) -> None:
    """Let this process use the GPU of its number on this machine, and no other."""
    count = torch.cuda.device_count()
    if place.local_size > count:
        message = (
            f"each process needs a GPU of its own, got {place.local_size} processes and {count} on this machine; "
            f"torchrun --nproc-per-node {count}, or --backend cpu"
        )
        if place.local_rank == 0:
            raise BackendError(message)
        raise LostContactError(message, told=True)
    torch.cuda.set_device(place.local_rank)


def memory_of(place: Place, gib: float | None) -> float | None:
    """Return what of the memory this process keeps to, GiB: of ``--memory``, or of what there is, an equal part."""
    if place.local_size == 1:
        return gib
    limit = memory_limit()
    whole = gib if gib is not None else None if limit is None else limit.bytes / GIB
    return None if whole is None else whole / place.local_size


def lead(loaded: LoadedRun, together: OneProcess, on_event: OnEvent) -> LoadedRun:
    """Tell the others what this process trains, and the user that there are others."""
    if not isinstance(together, ManyProcesses):
        return loaded
    rates = loaded.recipe.stages[0].lr
    rate = rates.for_views(together.size).sh0 / rates.sh0
    text = f"{together.size} processes: as many photographs an iteration, each a view; rates times {rate:.3g}"
    on_event(Notice(text))
    prepare = "always" if loaded.scene.ahead else "never"
    path = str(loaded.resolved.scene.path)
    together.tell({"scene": path, "prepare": prepare, "facts": _shared_facts(loaded)})
    return replace(loaded, processes=together.size)


def follow(options: TrainOptions, together: ManyProcesses) -> RunFolder:
    """Train along with process 0, to the last iteration.

    Raises
    ------
    RunError
        This process reads something else than process 0 does.
    LostContactError
        Process 0 has ended.
    """
    told: dict[str, Any] = together.tell({})
    same = replace(options, scene=Path(told["scene"]), prepare=told["prepare"])
    loaded = prepare_run(same, ignore)
    _check_same(told["facts"], _shared_facts(loaded))
    trainer = Trainer(
        loaded.scene,
        loaded.recipe,
        loaded.protocol,
        backend=loaded.backend,
        options=TrainerOptions(
            progress_every=progress_every(loaded),
            stage2_cache_bytes=loaded.resolved.stage2_cache_bytes,
            processes=together,
        ),
    )
    signals = HeldSignals()
    together.hears = lambda: signals.asked
    signals.hold()  # process 0 decides when to stop; a second one acts at once
    try:
        trainer.run()
    finally:
        with contextlib.suppress(KeyboardInterrupt):
            signals.forget()
    return RunFolder(options.out)


def _shared_facts(loaded: LoadedRun) -> dict[str, Any]:
    """Return what must be the same in all processes."""
    return {**loaded.resolved.decisive_facts(), "key": loaded.stage_key(len(loaded.recipe.stages) - 1)}


def _check_same(first: dict[str, Any], own: dict[str, Any]) -> None:
    for name, value in own.items():
        if first[name] != value:
            what = "versions" if name == "key" else name
            raise RunError(
                f"all processes must train the same, got another {what} than in process 0; give each the same command, "
                "capture and versions, on processors of one kind"
            )
