"""``verdict.json``: the verdict on a run and what it was judged by."""

from __future__ import annotations

from typing import Any

from gs2d.core.json_files import read_json, write_json
from gs2d.data.subject import OBJECT, read_subject
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import VERDICT, RunFolder
from gs2d.io.run_schema import VERDICT_SHAPE, check_shape
from gs2d.pipeline.finish.verdict.judge import FORMAT, judge
from gs2d.pipeline.finish.verdict.measures import Collector, Measures, measure, measures_from_json
from gs2d.pipeline.prepare.job import Job


def write_verdict(run: RunFolder, job: Job, collected: Collector) -> dict[str, Any]:
    """Judge a run and write ``verdict.json``; where no view was measured now, by what was measured before.

    Returns
    -------
    dict
        What the file holds.

    Raises
    ------
    RunError
        The views were scored, but never measured.
    DiskError
    """
    if collected.failure is not None:
        raise collected.failure
    if collected.views:
        subject = read_subject(run.path)
        center = subject.center if subject is not None and subject.kind == OBJECT else None
        measures = measure(job.scene, collected.views, center)
    else:
        measures = _measured_before(run)
    data = {"format": FORMAT, "verdict": judge(measures).to_json(), "measured": measures.to_json()}
    write_json(run.file(VERDICT), data)
    return data


def read_verdict(run: RunFolder) -> dict[str, Any] | None:
    """Return the verdict of a run as it was written, or None where there is none."""
    try:
        return dict(_read(run)["verdict"]) if run.file(VERDICT).exists() else None
    except (DataError, RunError):
        return None


def _read(run: RunFolder) -> dict[str, Any]:
    """Return what ``verdict.json`` holds, checked (DataError, RunError)."""
    path = run.file(VERDICT)
    data: dict[str, Any] = read_json(path)
    check_shape(path, data, VERDICT_SHAPE, "delete it: the verdict is made again with the run's next scores")
    return data


def _measured_before(run: RunFolder) -> Measures:
    if not run.file(VERDICT).exists():
        raise RunError("the views were scored before the run was broken off, and are not measured")
    return measures_from_json(_read(run).get("measured") or {})
