"""Photographs prepared on disk: the same results, by default if they do not fit into memory, within limits."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from benchmarks.flight import Flight, write_flight

from gs2d.config.presets import get_recipe
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import Recipe
from gs2d.config.schedule import scale_schedule
from gs2d.core import memory_limit
from gs2d.data import load_scene
from gs2d.data.prepared import SUFFIX, Stored
from gs2d.errors import DataError
from gs2d.pipeline.finish.run_mesh import mesh_run
from gs2d.pipeline.finish.run_report import report_run
from gs2d.pipeline.prepare import photographs
from gs2d.pipeline.prepare.limits import use_memory
from gs2d.pipeline.prepare.loaded import open_finished
from gs2d.pipeline.prepare.options import MeshOptions, TrainOptions
from gs2d.pipeline.prepare.photographs import PREPARED
from gs2d.pipeline.prepare.resolved import Execution
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice, Phase
from gs2d.training.trainer import Trainer

FLIGHT = Flight(12, width=64, height=48, points=6000, seed=1)
COARSE = replace(GENERIC, fusion=replace(GENERIC.fusion, voxel=3.0, truncation=15.0))  # m; fusion is not tested


@pytest.fixture(autouse=True)
def no_budget() -> object:
    yield
    memory_limit.set_memory_budget(None)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown") / "capture"
    write_flight(folder, FLIGHT)
    return folder


def options(capture: Path, out: Path, prepare: str, recipe: str | Recipe = "2dgs", **more: object) -> TrainOptions:
    given = {"schedule_scale": 0.001, "page": False, "threads": 2, "protocol": COARSE, **more}
    return TrainOptions(scene=capture, out=out, recipe=recipe, prepare=prepare, **given)  # type: ignore[arg-type]


def digest(run: Path, name: str = "splats.ply") -> str:
    return hashlib.sha256((run / name).read_bytes()).hexdigest()


@pytest.mark.parametrize("recipe", ["2dgs-r", "best"])
def test_prepared_photographs_give_the_same_splats(capture: Path, tmp_path: Path, recipe: str) -> None:
    scene = load_scene(capture, test_every=0)
    chosen = photographs.with_prepared(scene, tmp_path, Execution(prepare="always"), lambda event: None)
    assert chosen.ahead > 0
    short = scale_schedule(get_recipe(recipe), 0.0005)
    found = [Trainer(given, short, COARSE, backend="auto").run() for given in (chosen, scene)]
    for (name, one), (_, other) in zip(found[0].items(), found[1].items(), strict=True):
        assert torch.equal(one, other), name


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["2dgs-r", "best"])
def test_prepared_photographs_give_the_same_bytes_of_a_run(capture: Path, tmp_path: Path, recipe: str) -> None:
    heard: list[Event] = []
    train(options(capture, tmp_path / "disk", "always", recipe), heard.append)
    train(options(capture, tmp_path / "memory", "never", recipe))
    assert digest(tmp_path / "disk") == digest(tmp_path / "memory")
    assert digest(tmp_path / "disk", "mesh.ply") == digest(tmp_path / "memory", "mesh.ply")
    assert len(list((tmp_path / "disk" / PREPARED).glob(f"*{SUFFIX}"))) == 12
    assert not (tmp_path / "memory" / PREPARED).exists()
    phases = [event.name for event in heard if isinstance(event, Phase)]
    assert phases.index("preparing photographs") < phases.index("reading photographs")


@pytest.mark.slow
def test_later_commands_use_prepared_photographs(capture: Path, tmp_path: Path) -> None:
    run = train(options(capture, tmp_path / "run", "always"))
    _, job, _ = open_finished(run.path, None, lambda event: None)
    assert all(isinstance(view.decode, Stored) for view in job.scene.views)
    use_memory(2.0)
    again = mesh_run(run.path, MeshOptions(whole_scene=True, keep_components=0), out=tmp_path / "again.ply")
    assert again["voxel"] == 3.0
    assert report_run(run.path).exists()
    for file in (run.path / PREPARED).iterdir():  # deleted to free space
        file.unlink()
    (run.path / PREPARED).rmdir()
    _, job, _ = open_finished(run.path, None, lambda event: None)
    assert not any(isinstance(view.decode, Stored) for view in job.scene.views)


def test_photographs_that_do_not_fit_into_memory_are_prepared(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, heard = load_scene(capture), []
    assert photographs.with_prepared(scene, tmp_path, Execution(prepare="auto"), heard.append) is scene
    assert heard == []
    assert list(tmp_path.iterdir()) == []
    small = load_scene(capture, cache_bytes=12 * 64 * 48 * 3 - 1)
    chosen = photographs.with_prepared(small, tmp_path, Execution(prepare="auto"), heard.append)
    assert all(isinstance(view.decode, Stored) for view in chosen.views)
    said = next(event.text for event in heard if isinstance(event, Notice))
    assert "do not fit into memory: prepared in" in said
    assert photographs.with_prepared(small, tmp_path / "no", Execution(prepare="never"), heard.append) is small


def test_an_interrupted_preparation_continues(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "run"

    def stop(event: Event) -> None:
        if isinstance(event, Phase) and event.name == "reading photographs":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(options(capture, out, "always"), stop)
    assert [path.name for path in out.iterdir()] == [PREPARED]
    times = {path: path.stat().st_mtime_ns for path in (out / PREPARED).iterdir()}
    with pytest.raises(KeyboardInterrupt):
        train(options(capture, out, "always"), stop)
    assert {path: path.stat().st_mtime_ns for path in (out / PREPARED).iterdir()} == times


def test_a_memory_limit_bounds_caches_and_the_size_of_photographs(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_memory(3.0)
    limit = memory_limit.memory_limit()
    assert limit is not None
    assert (limit.bytes, limit.source) == (3 << 30, "--memory")
    assert memory_limit.cache_bytes(1 << 40) <= 0.6 * 2**30
    assert memory_limit.memory_budget() == 3 << 30
    use_memory(None)
    whole = memory_limit.memory_limit()
    assert whole is not None
    assert memory_limit.memory_budget() == whole.bytes // 2
    monkeypatch.setattr("gs2d.pipeline.prepare.limits.ITERATION_BYTES", 1 << 40)  # at no downscale
    with pytest.raises(DataError, match="--memory"):
        train(options(capture, tmp_path / "run", "auto", memory=1.0))
