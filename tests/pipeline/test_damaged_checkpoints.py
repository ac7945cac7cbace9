"""Damaged checkpoints that torch can read are skipped, with a notice."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from ball_runs import Stop, comparable, options
from gs2d.io.run_dir import CheckpointFile, RunFolder, load_tensors, save_tensors
from gs2d.pipeline.prepare.loaded import LoadedRun, prepare_run
from gs2d.pipeline.train.resume import choose_start
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice, Step, ignore
from gs2d.training.state import TrainState


@pytest.fixture(scope="module")
def stopped(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run that was broken off in its first stage: two checkpoints, with moments, statistics and a queue."""

    def listen(event: Event) -> None:
        if isinstance(event, Step) and event.done >= 13 and "loss" in event.detail:
            raise Stop

    out = tmp_path_factory.mktemp("stopped") / "run"
    with pytest.raises(Stop):
        train(options(capture, out), listen)
    return RunFolder(out)


@pytest.fixture(scope="module")
def job(capture: Path) -> LoadedRun:
    return prepare_run(options(capture, Path("unused")), ignore)


def resumed(
    run: RunFolder, job: LoadedRun, capture: Path, payload: dict[str, Any]
) -> tuple[TrainState | None, list[str]]:
    """Return the checkpoint that training resumes from if the last one holds ``payload``, and the notices."""
    save_tensors(run.checkpoints()[-1].path, payload)
    heard: list[Event] = []
    state, _ = choose_start(run, job, heard.append)
    return state, [event.text for event in heard if isinstance(event, Notice)]


def with_change(payload: dict[str, Any], path: tuple[Any, ...], change: Callable[[Any], Any]) -> dict[str, Any]:
    """Return a copy in which one entry is another; one that becomes ``...`` is left out."""
    changed = copy.deepcopy(payload)
    inside = changed
    for key in path[:-1]:
        inside = inside[key]
    inside[path[-1]] = change(inside[path[-1]])
    if inside[path[-1]] is ...:
        del inside[path[-1]]
    return changed


def half(tensor: torch.Tensor) -> torch.Tensor:
    return tensor[: len(tensor) // 2].clone()


@pytest.mark.parametrize(
    ("path", "change"),
    [
        (("state", "splats", "means"), half),
        (("state", "splats", "means"), lambda t: t * torch.nan),
        (("state", "splats", "shN"), lambda t: t.double()),
        (("state", "splats", "quats"), lambda t: t.to_sparse()),
        (("state", "moments", "quats", "mean"), half),
        (("state", "moments", "quats", "square"), lambda t: t.int()),
        (("state", "moments", "quats", "steps"), lambda _: -1),
        (("state", "moments", "other"), lambda _: {"mean": torch.zeros(1), "square": torch.zeros(1), "steps": 1}),
        (("state", "groups", "high_error"), lambda _: torch.zeros(3, dtype=torch.bool)),
        (("state", "statistics", "count"), half),
        (("state", "statistics"), lambda _: {}),
        (("state", "generator"), half),
        (("state", "generator"), lambda t: torch.zeros_like(t)),
        (("state", "queue"), lambda _: [0, 99]),
        (("state", "queue"), lambda _: [-1]),
        (("state", "step"), lambda _: 11),
        (("state", "step"), lambda _: float("inf")),
        (("state", "stage"), lambda _: 7),
        (("state", "entered"), lambda _: False),
        (("state", "format"), lambda _: 2),
        (("state", "maps"), lambda _: {"shine": torch.zeros(4, 48, 48)}),
        (("state", "maps"), lambda _: {"shine": torch.zeros((99, 48, 48), dtype=torch.uint8)}),
        (("state",), lambda _: [1, 2]),
        (("events_bytes",), lambda _: -5),
        (("seconds",), lambda _: float("nan")),
        (("seconds",), lambda _: "[" * 100_000),
        (("state", "learned"), lambda _: {"exposure": {"values": torch.zeros(6, 3, 4)}}),
    ],
)
def test_a_checkpoint_with_inconsistent_entries_is_skipped(
    capture: Path,
    stopped: RunFolder,
    job: LoadedRun,
    tmp_path: Path,
    path: tuple[str, ...],
    change: Callable[[Any], Any],
) -> None:
    run = RunFolder(Path(shutil.copytree(stopped.path, tmp_path / "run")))
    payload = load_tensors(run.checkpoints()[-1].path)
    if path[-1] in ("other", "high_error"):
        payload = with_change(payload, path[:-1], lambda inner: inner | {path[-1]: None})
    state, said = resumed(run, job, capture, with_change(payload, path, change))
    assert state is not None
    assert state.step == 8
    assert "0-surface-0000012.pt is not a readable checkpoint" in said[0]
    assert "\n" not in said[0]


@pytest.mark.parametrize("readable", [True, False])
def test_training_from_the_previous_checkpoint_ends_with_the_same_bytes(
    capture: Path, stopped: RunFolder, undisturbed: RunFolder, tmp_path: Path, readable: bool
) -> None:
    run = RunFolder(Path(shutil.copytree(stopped.path, tmp_path / "run")))
    last = run.checkpoints()[-1].path
    if readable:
        save_tensors(last, with_change(load_tensors(last), ("state", "statistics", "signed"), lambda _: ...))
    else:
        last.write_bytes(b"damaged")
    heard: list[Event] = []
    assert comparable(train(options(capture, run.path, resume=True), heard.append)) == comparable(undisturbed)
    said = [event.text for event in heard if isinstance(event, Notice)]
    assert any(f"{last.name} is not a readable checkpoint" in text for text in said)


def test_a_damaged_stage_in_a_cache_is_trained_and_stored_again(
    capture: Path, undisturbed: RunFolder, tmp_path: Path
) -> None:
    cache = tmp_path / "cache"
    train(options(capture, tmp_path / "first", cache=cache))
    files = sorted(cache.glob("*.pt"), key=lambda path: load_tensors(path)["state"]["stage"])
    whole = [path.read_bytes() for path in files]
    files[2].write_bytes(whole[2][:1000])
    save_tensors(files[1], with_change(load_tensors(files[1]), ("metrics",), lambda _: "[]"))
    heard: list[Event] = []
    run = train(options(capture, tmp_path / "second", cache=cache), heard.append)
    assert comparable(run) == comparable(undisturbed)
    said = [event.text for event in heard if isinstance(event, Notice)]
    assert [sum(path.name in text for text in said) for path in files] == [1, 1, 1]
    assert [bool(load_tensors(path)["metrics"]) for path in files] == [True] * 3
    assert run.metrics()["stages"][0]["reused_from"] == str(files[0])


def test_a_checkpoint_with_the_name_of_another_is_skipped(
    capture: Path, stopped: RunFolder, job: LoadedRun, tmp_path: Path
) -> None:
    run = RunFolder(Path(shutil.copytree(stopped.path, tmp_path / "run")))
    last = run.checkpoints()[-1]
    last.path.rename(last.path.with_name("0-surface-end.pt"))
    state, said = resumed(run, job, capture, load_tensors(run.checkpoints()[-1].path))
    assert isinstance(last, CheckpointFile)
    assert state is not None
    assert state.step == 8
    assert "it holds stage 0, iteration 12" in said[0]
