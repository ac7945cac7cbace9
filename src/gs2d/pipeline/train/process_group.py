"""Train one run in several processes, as ``torchrun`` starts them.

Process 0 reads, decides, reports and writes as if it were alone. The others read the same capture and train along; they
write nothing.
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

from gs2d.core.processes import ProcessRank, process_rank
from gs2d.errors import BackendError, Gs2dError, RunError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.prepare.loaded import LoadedRun, prepare_run
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.train.run_logger import HeldSignals, progress_every
from gs2d.training.events import Notice, OnEvent, ignore
from gs2d.training.parallel import ONE_PROCESS, LostContactError, ProcessGroup
from gs2d.training.trainer import Trainer, TrainerOptions

PATIENCE = timedelta(days=7)  # the others wait while process 0 scores; a lost process is noticed by its connection


@contextmanager
def connected(backend: str) -> Iterator[ProcessGroup]:
    """Connect to the other processes, if the environment defines any.

    Each process uses a GPU of its own, unless the requested backend is of the CPU. Raises BackendError if a process has
    no GPU, or torch was built without ``torch.distributed``.
    """
    place = process_rank()
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
            raise LostContactError(str(error), reported=True) from error
        if isinstance(error, Gs2dError) and not place.leads:
            error.args = (f"process {place.rank} of {place.size}: {error}", *error.args[1:])
        raise
    gc.collect()  # work in reference cycles would end with the interpreter, in threads of gloo, which then abort
    torch.distributed.destroy_process_group()


def _connect(place: ProcessRank, backend: str) -> ProcessGroup:
    """Join the group of all processes, on a GPU of its own."""
    if not torch.distributed.is_available():
        raise BackendError("several processes need torch.distributed, which this torch does not have; use one")
    on_gpu, count = backend not in ("cpu", "reference") and torch.cuda.is_available(), torch.cuda.device_count()
    if on_gpu and place.local_size > count:
        message = (
            f"each process needs a GPU of its own, got {place.local_size} processes and {count} GPUs on this machine; "
            f"use torchrun --nproc-per-node {count}, or --backend cpu"
        )
        raise BackendError(message) if place.local_rank == 0 else LostContactError(message, reported=True)
    if on_gpu:
        torch.cuda.set_device(place.local_rank)
    both = on_gpu and torch.distributed.is_nccl_available()
    torch.distributed.init_process_group("cpu:gloo,cuda:nccl" if both else "gloo", timeout=PATIENCE)
    return ProcessGroup(place)


def lead(loaded: LoadedRun, together: ProcessGroup, on_event: OnEvent) -> LoadedRun:
    """Send the run to the other processes, and report how many there are."""
    if together.size == 1:
        return loaded
    rates = loaded.recipe.stages[0].lr
    rate = rates.for_views(together.size).sh0 / rates.sh0
    on_event(Notice(f"{together.size} processes: {together.size} views per iteration, learning rates times {rate:.3g}"))
    together.broadcast({"scene": str(loaded.resolved.scene.path), "fields": _shared_fields(loaded)})
    return replace(loaded, processes=together.size)


def follow(options: TrainOptions, together: ProcessGroup) -> RunFolder:
    """Train along with process 0, to the last iteration.

    Raises RunError if this process would train something else, LostContactError if process 0 has ended.
    """
    received: dict[str, Any] = together.broadcast({})
    loaded = prepare_run(replace(options, scene=Path(received["scene"])), ignore)
    for name, value in _shared_fields(loaded).items():
        if received["fields"][name] != value:
            raise RunError(
                f"all processes must train the same, got another {'versions' if name == 'key' else name} than process "
                "0; use the same command, capture and versions, on CPUs of one kind"
            )
    trainer = Trainer(
        loaded.scene,
        loaded.recipe,
        loaded.protocol,
        backend=loaded.backend,
        options=TrainerOptions(progress_every=progress_every(loaded), processes=together),
    )
    signals = HeldSignals()
    together.stop_requested = lambda: signals.pending
    signals.hold()  # process 0 decides when to stop; a second signal acts at once
    try:
        trainer.run()
    finally:
        with contextlib.suppress(KeyboardInterrupt):
            signals.forget()
    return RunFolder(options.out)


def _shared_fields(loaded: LoadedRun) -> dict[str, Any]:
    """Return what must be equal in all processes."""
    return {**loaded.resolved.decisive_fields(), "key": loaded.stage_key(len(loaded.recipe.stages) - 1)}
