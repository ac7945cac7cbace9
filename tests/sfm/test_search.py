"""Which stages of an interrupted search are kept, and a search that is killed several times."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gs2d.cli import run
from gs2d.sfm import search
from gs2d.sfm.search import forget, go_on
from gs2d.sfm.workspace import workspace
from room_photos import write_room

LAYERS = {"photographs": [1], "features": [2], "pairs": [3], "mapping": [4]}


@pytest.mark.parametrize(
    ("changed", "left"),
    [
        ("", {"capture", "database.db", "pairs.txt", "mapping"}),
        ("mapping", {"capture", "database.db", "pairs.txt"}),
        ("pairs", {"capture"}),  # the unreadable database is removed
        ("features", {"capture"}),
        ("photographs", set()),
    ],
)
def test_layers_with_equal_inputs_are_kept(tmp_path: Path, changed: str, left: set[str]) -> None:
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
def test_a_search_that_is_killed_repeatedly_gives_the_same_result(colmap: None, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    write_room(photos, 12)
    assert run(["poses", str(photos), "--out", str(tmp_path / "whole"), "--threads", "2", "--quiet"]) == 0
    out, work = tmp_path / "capture", tmp_path / ".capture.poses"
    words = [sys.executable, "-m", "gs2d", "poses", str(photos), "--out", str(out), "--threads", "2", "--overwrite"]
    for phase in ("finding features", "matching pairs", "placing cameras", "placing cameras", "adjusting the lens"):
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
    assert killed["placed"] == whole["placed"] == 12
    assert killed["mean_error_px"] == pytest.approx(whole["mean_error_px"], rel=0.02)
    assert killed["points"] == pytest.approx(whole["points"], rel=0.02)
    assert not work.exists()
