"""A sweep on Slurm, through submitit (extra ``slurm``): every slot is a Slurm job that works off the same list."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from typing import Any

from gs2d.core.extras import install
from gs2d.errors import BackendError, RunError
from gs2d.experiments.execute import Sweep, SweepJob, watch, work
from gs2d.pipeline.events import Notice, OnEvent


def run_on_slurm(
    sweep: Sweep,
    on_event: OnEvent,
    *,
    slots: int,
    parameters: Mapping[str, Any],
    after_job: Callable[[SweepJob], None],
    executor: Any = None,
) -> None:
    """Submit ``slots`` jobs, each of which works until the list is done, and wait for the list.

    The folders must be on a disk that the nodes share. A Slurm job that dies is not submitted again; its runs are
    taken over by the others, or by the next command with the same --out.

    Parameters
    ----------
    parameters : mapping
        For ``AutoExecutor.update_parameters``: ``slurm_partition``, ``timeout_min``, ``gpus_per_node`` ...
    executor : object, optional
        What submits, with the interface of ``submitit.AutoExecutor``; default: one for Slurm.

    Raises
    ------
    BackendError
        submitit is not installed, Slurm is not there, or a parameter is none of submitit's.
    RunError
        All Slurm jobs ended and runs are left.
    """
    if executor is None:
        executor = _slurm_executor(sweep)
    try:
        executor.update_parameters(**parameters)
    except (NameError, TypeError, ValueError) as error:
        raise BackendError(f"--slurm {dict(parameters)} is not what submitit takes: {error}") from error
    submitted = [executor.submit(work, sweep) for _ in range(min(slots, len(sweep.jobs)))]
    on_event(Notice("submitted as " + ", ".join(str(job.job_id) for job in submitted)))

    def check() -> None:
        if all(job.done() for job in submitted) and sweep.unsettled():
            why = next((str(error).splitlines()[-1] for job in submitted if (error := job.exception())), "no message")
            raise RunError(
                f"the Slurm jobs ended before the runs were done ({why}); their logs are in {sweep.folder / 'slurm'}; "
                "run the command again to go on"
            )

    try:
        watch(sweep, on_event, after_job, check)
    except BaseException:
        for job in submitted:
            if not job.done():
                job.cancel()
        raise


def _slurm_executor(sweep: Sweep) -> Any:
    try:
        import submitit
    except ModuleNotFoundError as error:
        raise BackendError(
            f"--slurm needs submitit, which is not installed; {install('slurm')}, or leave --slurm out"
        ) from error
    if shutil.which("sbatch") is None:
        raise BackendError(
            "--slurm needs Slurm's command sbatch on this machine, which is not there; or leave --slurm out"
        )
    return submitit.AutoExecutor(folder=sweep.folder / "slurm", cluster="slurm")
