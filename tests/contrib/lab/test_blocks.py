"""`gs2d blocks`: one run of several blocks, gone on with after any interruption to the same bytes."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.flight import Flight, write_flight

from flown import CHANGES, PARTITION, digest, tiny_blocks
from gs2d.contrib.lab import blocks as module
from gs2d.contrib.lab.block_start import FROZEN, OWN, read_start
from gs2d.contrib.lab.blocks import blocks
from gs2d.contrib.lab.split import read_split
from gs2d.errors import DataError, Gs2dError, RecipeError, RunError
from gs2d.io.run_dir import open_run
from gs2d.io.splat_ply import read_splats
from gs2d.training.events import Event


@pytest.fixture(scope="module")
def straight(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("straight") / "job"
    blocks(tiny_blocks(capture, out))
    return out


def test_the_job_is_a_run_of_all_blocks(straight: Path) -> None:
    run_folder = open_run(straight)
    (stage,) = run_folder.metrics()["stages"]
    assert stage["name"] == "blocks"
    assert stage["iterations"] == 9 + 4 * 18 + 4  # coarse, blocks, seams
    assert stage["splats"] == len(read_splats(straight / "splats.ply"))
    assert stage["train"]["psnr"] > 6
    assert stage["test"]["psnr"] > 6
    assert run_folder.definition()["partition"]["grid"] == [2, 2]
    for name in ("mesh.ply", "report.html", "verdict.json"):
        assert (straight / name).exists()


def test_each_block_trained_its_own_splats_and_photographs_with_the_rest_frozen(straight: Path) -> None:
    split, coarse = read_split(straight / "partition"), read_splats(straight / "coarse/splats.ply")
    places = coarse.means.numpy()
    assert len(split.blocks) == 4
    for cell, block in enumerate(split.blocks):
        rows, exposures = read_start(straight / "partition" / f"{block.name}.npz")
        own, frozen = rows == OWN, rows == FROZEN
        assert exposures is None
        assert (own.sum(), frozen.sum()) == (block.own, block.frozen)
        assert split.cells.near(cell, places[own]).all()
        assert not split.cells.near(cell, places[frozen]).any()
        definition = open_run(straight / "blocks" / block.name).definition()
        assert definition["scene"]["train"] == len(block.views) >= 3
        assert definition["scene"]["test"] == 0
        assert definition["raster"] == open_run(straight).definition()["raster"]
    assert sum(block.core for block in split.blocks) == len(coarse)


class StoppedError(BaseException):
    """As a kill: nobody catches it."""


def stopping_after(events: int) -> Callable[[Event], None]:
    left = [events]

    def listen(_event: Event) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise StoppedError

    return listen


def test_a_job_that_is_broken_off_in_a_block_ends_with_the_same_bytes(
    capture: Path, straight: Path, tmp_path: Path
) -> None:
    for name in ("blocks.json", "coarse", "partition", "jobs"):
        copy = shutil.copytree if (straight / name).is_dir() else shutil.copy
        (tmp_path / "job").mkdir(exist_ok=True)
        copy(straight / name, tmp_path / "job" / name)
    options = tiny_blocks(capture, tmp_path / "job", threads=2)
    with pytest.raises(StoppedError):
        blocks(options, stopping_after(30))
    assert list((tmp_path / "job/blocks").glob("*/checkpoints/*.pt"))
    assert not (tmp_path / "job/splats.ply").exists()
    blocks(options)
    assert digest(tmp_path / "job/splats.ply") == digest(straight / "splats.ply")


def test_a_damaged_beginning_of_a_block_is_one_line_and_is_made_again_when_it_is_deleted(
    capture: Path, straight: Path, tmp_path: Path
) -> None:
    job = tmp_path / "job"
    shutil.copytree(straight, job)
    start = job / "partition/0-1.npz"
    start.write_bytes(start.read_bytes()[:50])
    shutil.rmtree(job / "blocks/0-1")
    (job / "splats.ply").unlink()
    (job / "jobs/merge.json").unlink()
    with pytest.raises(RunError, match=r"block-0-1 failed: .*0-1.npz is not the start of a block"):
        blocks(tiny_blocks(capture, job))
    assert (job / "blocks/1-1/splats.ply").exists()
    start.unlink()
    blocks(tiny_blocks(capture, job))
    assert digest(job / "splats.ply") == digest(straight / "splats.ply")


@pytest.mark.slow
def test_blocks_of_the_default_recipe_begin_with_a_dense_start_of_their_own_cell_and_settled_exposures(
    tmp_path: Path,
) -> None:
    capture, job = tmp_path / "capture", tmp_path / "job"
    write_flight(capture, Flight(16, width=64, height=48, points=800, side=90.0), threads=1)
    options = tiny_blocks(
        capture, job, recipe="best", robust="auto", learn="exposure", overrides=PARTITION, schedule_scale=0.002
    )
    blocks(options)
    split, starts = read_split(job / "partition"), []
    for cell, block in enumerate(split.blocks):
        run_folder = open_run(job / "blocks" / block.name)
        (begun,) = (event for event in run_folder.events.read() if event["kind"] == "initialised")
        assert begun["source"] == "sweep"
        starts.append(begun["splats"])
        trained = read_splats(run_folder.path / "splats.ply").means.numpy()
        assert split.cells.near(cell, trained).mean() > 0.95  # a few wander
        coarse = json.loads((job / "coarse/learned.json").read_text())["views"]
        for name, found in json.loads((run_folder.path / "learned.json").read_text())["views"].items():
            assert np.allclose(found["exposure"], coarse[name]["exposure"], atol=1e-6)
        assert run_folder.definition()["protocol"] == open_run(job).definition()["protocol"]
    assert min(starts) > 50
    assert json.loads((job / "learned.json").read_text())["views"] == coarse


# -- what differs ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"blocks": "2x3"}, r"begun with another partition \(grid.1: 2, now 3\)"),
        (
            {"overrides": tuple(text.replace("min_views=3", "min_views=4") for text in CHANGES)},
            r"another partition \(min_views: 3, now 4\)",
        ),
        ({"schedule_scale": 0.001}, "begun with another recipe"),
        ({"seed": 3}, r"begun with another recipe \(seed: 0, now 3\)"),
        ({"downscale": 2}, "begun with another capture"),
        ({"protocol": "tnt"}, "begun with another protocol"),
    ],
)
def test_a_job_goes_on_as_it_was_begun(capture: Path, straight: Path, changes: dict[str, Any], text: str) -> None:
    with pytest.raises(RunError, match=text):
        blocks(tiny_blocks(capture, straight, **changes))
    assert (straight / "splats.ply").exists()


def test_a_capture_that_changed_is_told_and_nothing_is_lost(straight: Path, capture: Path, tmp_path: Path) -> None:
    job, other = tmp_path / "job", tmp_path / "capture"
    shutil.copytree(straight, job)
    shutil.copytree(capture, other)
    blocks(tiny_blocks(other, job))  # the same photographs elsewhere
    photograph = other / "images/000003.jpg"
    os.utime(photograph, ns=(1, 1))
    with pytest.raises(RunError, match="begun with another capture: photographs, cameras or points of .* changed"):
        blocks(tiny_blocks(other, job))
    assert digest(job / "splats.ply") == digest(straight / "splats.ply")


# -- bad input ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"blocks": "0x2"}, "--blocks must be auto, or two or three whole numbers of 1 or more"),
        ({"slots": 0}, "--set slots must be a whole number >= 1, got 0"),
        ({"recipe": "no-such"}, "no-such"),
        ({"overrides": ("partition.margin=2",)}, "partition.margin must be at most 1"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(
    capture: Path, tmp_path: Path, changes: dict[str, Any], text: str
) -> None:
    with pytest.raises(RecipeError, match=text):
        blocks(tiny_blocks(capture, tmp_path / "job", **changes))
    assert not (tmp_path / "job").exists()


@pytest.mark.slow
def test_a_block_that_fails_leaves_the_others_and_the_merge_waits(
    capture: Path, straight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = module.train

    def failing(options: Any, on_event: Any, **more: Any) -> Any:
        if options.out.name == "0-1":
            raise DataError("the disk is full")
        return real(options, on_event, **more)

    monkeypatch.setattr(module, "train", failing)
    job = tmp_path / "job"
    with pytest.raises(Gs2dError, match="block-0-1 failed: the disk is full; finished tasks are kept"):
        blocks(tiny_blocks(capture, job))
    states = {path.stem: json.loads(path.read_text())["state"] for path in (job / "jobs").glob("*.json")}
    assert states.pop("block-0-1") == "failed"
    assert {states.pop(name) for name in ("merge", "seams", "finish")} == {"failed"}
    assert set(states.values()) == {"done"}
    assert not (job / "splats.ply").exists()
    monkeypatch.setattr(module, "train", real)
    blocks(tiny_blocks(capture, job))
    assert digest(job / "splats.ply") == digest(straight / "splats.ply")
