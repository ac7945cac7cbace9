"""Mapping that goes on after an interruption: models that are done, snapshots, steps. On COLMAP's synthetic matches."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from gs2d.cli import run
from gs2d.sfm import search, steps
from gs2d.sfm.grow import grow_all
from gs2d.sfm.search import forget, go_on
from gs2d.sfm.steps import Steps
from gs2d.sfm.workspace import workspace
from room_photos import write_room

COUNT = 12


@pytest.fixture(scope="module")
def pycolmap(colmap: None) -> Any:
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    return pycolmap


@pytest.fixture
def matches(pycolmap: Any, tmp_path: Path) -> tuple[str, Any]:
    """A database with what photographs share, and options for mapping."""
    pycolmap.set_random_seed(0)
    wanted = pycolmap.SyntheticDatasetOptions()
    wanted.num_rigs, wanted.num_frames_per_rig, wanted.num_points3D = 1, COUNT, 200
    database = pycolmap.Database.open(str(tmp_path / "database.db"))
    truth = pycolmap.synthesize_dataset(wanted, database)
    database.close()
    for image in truth.images.values():
        Image.new("RGB", (truth.camera(1).width, truth.camera(1).height)).save(tmp_path / image.name)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.image_path = 1, 0, str(tmp_path)
    return str(tmp_path / "database.db"), options


def ended_at(number: int) -> Any:
    """A counter of photographs that ends the process, as far as mapping can tell, when so many have a place."""
    placed = 0

    def count(more: int) -> None:
        nonlocal placed
        placed += more
        if placed >= number:
            raise RuntimeError("ended")

    return count


def test_a_model_grows_on_from_its_snapshot(
    pycolmap: Any, matches: tuple[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steps, "SOONEST", 0.0)
    monkeypatch.setattr(steps, "SHARE", 0.0)
    database, options = matches
    done = Steps(tmp_path / "mapping")
    with pytest.raises(RuntimeError, match="ended"):
        grow_all(pycolmap, database, options, done, "grown", ended_at(8), often=True)
    snapshots = done.names("grown-snapshot")
    assert len(snapshots) == 2
    assert max(done.read(pycolmap, name).num_reg_images() for name in snapshots) == 7  # before the last callback
    counted: list[int] = []
    grow_all(pycolmap, database, options, done, "grown", counted.append, often=True)
    assert counted[0] == 7
    assert done.names("grown") == ["grown-0"]
    assert done.read(pycolmap, "grown-0").num_reg_images() == COUNT
    again: list[int] = []
    grow_all(pycolmap, database, options, done, "grown", again.append, often=True)  # all is done
    assert again == [COUNT]


# -- what is kept of a search ------------------------------------------------------------------------------------------
LAYERS = {"photographs": [1], "features": [2], "pairs": [3], "mapping": [4]}


@pytest.mark.parametrize(
    ("changed", "left"),
    [
        ("", {"capture", "database.db", "pairs.txt", "mapping"}),
        ("mapping", {"capture", "database.db", "pairs.txt"}),
        ("pairs", {"capture"}),  # here the database is none, and cannot be cleared
        ("features", {"capture"}),
        ("photographs", set()),
    ],
)
def test_what_the_next_search_would_make_alike_is_kept(tmp_path: Path, changed: str, left: set[str]) -> None:
    out = tmp_path / "room"
    with workspace(out) as work:
        assert go_on(work, LAYERS, ours=("capture",)) == ""
        for name in ("capture", "mapping"):
            (work / name).mkdir()
        for name in ("database.db", "pairs.txt"):
            (work / name).write_text("no database")
    with workspace(out) as work:
        go_on(work, {**LAYERS, changed: [5]} if changed else LAYERS, ours=("capture",))
        assert {path.name for path in work.iterdir()} - {search.SEARCH, ".lock"} == left
        forget(work)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_a_search_that_is_killed_five_times_places_what_one_without_kills_does(colmap: None, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    write_room(photos, 54)  # more than are mapped again from nothing
    assert run(["poses", str(photos), "--out", str(tmp_path / "whole"), "--threads", "2", "--quiet"]) == 0
    out, work = tmp_path / "capture", tmp_path / ".capture.poses"
    words = [sys.executable, "-m", "gs2d", "poses", str(photos), "--out", str(out), "--threads", "2", "--overwrite"]
    for phase in ("finding features", "matching pairs", "placing cameras", "placing cameras", "comparing lenses"):
        with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
            assert process.stderr is not None
            for line in process.stderr:
                if line.startswith(phase):
                    time.sleep(1.0)
                    process.send_signal(signal.SIGKILL)
                    break
        assert (work / search.SEARCH).exists() or out.exists()
    assert run(["poses", str(photos), "--out", str(out), "--threads", "2", "--quiet", "--overwrite"]) == 0
    killed, whole = (json.loads((path / "poses.json").read_text()) for path in (out, tmp_path / "whole"))
    assert killed["placed"] == whole["placed"] == 54
    assert killed["mean_error_px"] == pytest.approx(whole["mean_error_px"], rel=0.02)
    assert killed["points"] == pytest.approx(whole["points"], rel=0.02)
    assert not work.exists()
