"""Choose where training starts: at a checkpoint, after the stages of a cache, or from nothing."""

from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path
from typing import Any

from gs2d.core.atomic_files import sweep
from gs2d.errors import RunError, ShapeError
from gs2d.io.run_dir import CheckpointFile, RunFolder, load_tensors, make_folder, save_tensors
from gs2d.io.run_schema import METRICS_SHAPE, check_shape
from gs2d.pipeline.prepare.loaded import LoadedRun
from gs2d.training.events import Notice, OnEvent
from gs2d.training.resumable import check_resumable
from gs2d.training.state import TrainState


def choose_start(run: RunFolder, loaded: LoadedRun, on_event: OnEvent) -> tuple[TrainState | None, float]:
    """Return the furthest valid start; log and metrics are cut to it.

    That is a state, or None: from nothing; and the seconds of training already spent in the current stage. Raises
    RunError if no checkpoint is readable.
    """
    cache = loaded.resolved.execution.cache
    if run.checkpoints():
        return _resume(run, loaded, on_event)
    run.events.cut(0)
    if cache is not None and (state := _from_cache(run, loaded, cache, on_event)) is not None:
        return state, 0.0
    run.write_metrics({"stages": [], "surface": None})
    return None, 0.0


def _resume(run: RunFolder, loaded: LoadedRun, on_event: OnEvent) -> tuple[TrainState, float]:
    for checkpoint in reversed(run.checkpoints()):
        try:
            payload = _read(checkpoint.path)
            state = _state_at(checkpoint, payload, loaded)
        except RunError as error:
            on_event(Notice(f"{error}; using the previous checkpoint"))
            continue
        run.events.cut(payload["events_bytes"])
        finished = checkpoint.stage_index + (checkpoint.iteration is None)
        metrics, retained = run.metrics(), {"surface": None}
        if finished == len(loaded.recipe.stages):  # the mesh is still valid
            retained |= {name: metrics[name] for name in ("surface", "mesh") if name in metrics}
        run.write_metrics({"stages": metrics["stages"][:finished], **retained})
        on_event(Notice(f"resuming after {checkpoint.path.stem}"))
        return state, payload["seconds"]
    raise RunError(f"no checkpoint in {run.path} is readable; train again with --overwrite")


# -- reading checkpoints -----------------------------------------------------------------------------------------------
def _read(path: Path) -> dict[str, Any]:
    """Return the contents of a checkpoint, complete and of the types that ``RunLogger`` writes."""
    payload = load_tensors(path)
    try:
        size, seconds = payload["events_bytes"], payload["seconds"]
        valid = isinstance(size, int) and size >= 0 and isinstance(seconds, float) and 0 <= seconds < math.inf
        if not (valid and isinstance(payload["key"], str) and isinstance(payload["state"], dict)):
            raise ValueError("a value of another type")
    except (LookupError, ValueError) as error:
        raise _unreadable(path, f"{type(error).__name__}: {error}") from error
    return payload


def _unreadable(path: Path, reason: str) -> RunError:
    return RunError(f"{path} is not a readable checkpoint ({' '.join(reason.split())[:300]}); delete it")


def _state_at(checkpoint: CheckpointFile, payload: dict[str, Any], loaded: LoadedRun) -> TrainState:
    """Return the state of a checkpoint, if it matches the name of its file and training can resume from it."""
    ended = checkpoint.iteration is None
    try:
        state = TrainState.from_state_dict(payload["state"])
        check_resumable(state, loaded.recipe, loaded.scene)
    except (RunError, ShapeError) as error:
        raise _unreadable(checkpoint.path, str(error)) from error
    if (state.stage, state.step) != (checkpoint.stage_index + ended, 0 if ended else checkpoint.iteration):
        raise _unreadable(checkpoint.path, f"it holds stage {state.stage}, iteration {state.step}")
    return state


# -- stages in a cache -------------------------------------------------------------------------------------------------
def _cache_file(folder: Path, key: str) -> Path:
    return folder / f"{key[:32]}.pt"


def _from_cache(run: RunFolder, loaded: LoadedRun, folder: Path, on_event: OnEvent) -> TrainState | None:
    """Copy the finished stages of another run into this one, as far as the cache has them; delete damaged files."""
    sweep(folder)
    for index, stage in reversed(list(enumerate(loaded.recipe.stages))):
        path = _cache_file(folder, loaded.stage_key(index))
        if not path.exists():
            continue
        try:
            payload, state = _cached(loaded, index, path)
        except RunError as error:
            on_event(Notice(f"{error}: deleted, the stage is trained again"))
            with contextlib.suppress(OSError):
                path.unlink()
            continue
        run.events.append_text(payload.pop("log").encode())
        metrics = [{**entry, "reused_from": str(path)} for entry in json.loads(payload.pop("metrics"))]
        run.write_metrics({"stages": metrics, "surface": None})
        run.save_checkpoint(index, stage.name, None, {k: v for k, v in payload.items() if k != "events_bytes"})
        on_event(Notice(f"stages up to {stage.name!r} are reused from {path}"))
        return state
    return None


def _cached(loaded: LoadedRun, index: int, path: Path) -> tuple[dict[str, Any], TrainState]:
    """Return a checked file of the cache, and its state."""
    payload = _read(path)
    state = _state_at(CheckpointFile(path, index, loaded.recipe.stages[index].name, None), payload, loaded)
    try:
        metrics = json.loads(payload["metrics"])
        payload["log"].encode()
    except (LookupError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise _unreadable(path, f"{type(error).__name__}: {error}") from error
    check_shape(path, {"stages": metrics}, METRICS_SHAPE, "delete it")
    if payload["key"] != loaded.stage_key(index) or len(metrics) != index + 1:
        raise _unreadable(path, "it is of another stage")
    return payload, state


def put_in_cache(folder: Path, run: RunFolder, index: int, payload: dict[str, Any]) -> None:
    """Store a finished and scored stage for other runs."""
    make_folder(folder)
    path = _cache_file(folder, payload["key"])
    if not path.exists():
        log = run.events.read_bytes(payload["events_bytes"]).decode()
        stages = [{k: v for k, v in m.items() if k != "reused_from"} for m in run.metrics()["stages"][: index + 1]]
        save_tensors(path, {**payload, "metrics": json.dumps(stages), "log": log})
