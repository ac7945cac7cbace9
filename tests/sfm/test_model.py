"""Messages about images without a pose, a worker that crashes, and output folders in use. Runs without COLMAP."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gs2d.data.readers.colmap import ColmapImage, ColmapPoints
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import RunFolder
from gs2d.sfm.colmap_process import MatchCounts, Request, solve
from gs2d.sfm.compare import device_of
from gs2d.sfm.model import SfmModel, why_not_placed
from gs2d.sfm.workspace import check_out, put_in_place, workspace


def piece(*names: str) -> SfmModel:
    images = tuple(ColmapImage(i, 1, name, np.eye(4)) for i, name in enumerate(names))
    points = ColmapPoints(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0))
    return SfmModel(images, {}, points, 0.5, 3.0, 20.0, True)


FEATURES = {**dict.fromkeys("abcdefg", 900), "blurred": 7}
COUNTS = MatchCounts(
    FEATURES,
    {("a", "b"): 300, ("a", "c"): 250, ("d", "a"): 17, ("d", "b"): 21, ("e", "f"): 400, ("g", "blurred"): 16},
)
PIECES = [piece("a", "b", "c"), piece("x", "y", "z")]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("y", "in a separate model (sparse/1): too few matches with the photographs of sparse/0"),
        ("blurred", "7 features: blurred, or without texture"),
        ("d", "too few matches with placed photographs (at most 21, with b)"),
        ("e", "matches only photographs that are not placed either (f)"),
        ("g", "matches only photographs that are not placed either (blurred)"),
        ("lonely", "no matches with any other photograph"),
    ],
)
def test_the_reason_for_an_unplaced_photograph(name: str, expected: str) -> None:
    counts = MatchCounts({**FEATURES, "lonely": 500, "y": 900}, COUNTS.matches)
    assert why_not_placed(name, PIECES, counts) == expected


# -- the worker --------------------------------------------------------------------------------------------------------
def request(work: Path) -> Request:
    return {"database": str(work / "database.db"), "groups": [{"camera_model": "OPENCV"}]}


def follow(work: Path, code: str) -> tuple[list[object], dict[str, Any]]:
    """Run a worker with this Python code, in which ``say(...)`` sends a message."""
    program = "import json, os, sys\ndef say(**m): print(json.dumps(m), flush=True)\n" + code
    steps: list[object] = []
    solved = solve(request(work), lambda *step: steps.append(step), command=(sys.executable, "-c", program))
    return steps, solved


def test_messages_of_the_worker_become_progress(tmp_path: Path) -> None:
    code = (
        "assert json.load(open(sys.argv[1]))['groups'][0]['camera_model'] == 'OPENCV'\n"
        "say(phase='cameras', total=5); say(done=2); say(done=5); say(models=[{'upright': True}])"
    )
    steps, solved = follow(tmp_path, code)
    assert steps == [("placing cameras", 0, 5), ("placing cameras", 2, 5), ("placing cameras", 5, 5)]
    assert solved["models"] == [{"upright": True}]


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        (
            "raise RuntimeError('database or disk is full')",
            "ended with code 1 while starting: .*database or disk is full",
        ),
        (
            "say(phase='matching', total=3); os.kill(os.getpid(), 11)",
            "was ended by signal 11 while matching pairs: .*--threads",
        ),
        ("say(phase='features', total=3)", "ended with code 0 while finding features: no output"),
    ],
)
def test_a_failing_worker_is_a_one_line_error(tmp_path: Path, code: str, expected: str) -> None:
    with pytest.raises(DataError, match=expected) as caught:
        follow(tmp_path, code)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("end", ["os.kill(os.getpid(), 6)", "raise RuntimeError('no CUDA-capable device')"])
def test_a_failure_on_the_gpu_is_repeated_on_the_cpu(tmp_path: Path, end: str) -> None:
    code = (
        "import json, os, sys\ndef say(**m): print(json.dumps(m), flush=True)\n"
        "on_cpu = json.load(open(sys.argv[1])).get('on_cpu')\n"
        f"if not on_cpu:\n say(gpu=True); say(phase='features', total=3); {end}\n"
        "say(models=[])"
    )
    notes: list[str] = []
    words = (sys.executable, "-c", code)
    assert solve(request(tmp_path), lambda *step: None, notes.append, command=words) == {"models": []}
    assert len(notes) == 1
    assert "while finding features" in notes[0]
    assert notes[0].endswith("on the GPU; continuing on the CPU")
    late = code.replace("'features'", "'cameras'").replace("if not on_cpu", "if True")
    with pytest.raises(DataError, match="while placing cameras"):  # placing cameras does not use the GPU
        solve(request(tmp_path), lambda *step: None, command=(sys.executable, "-c", late))


def test_features_are_on_the_gpu_where_colmap_was_built_for_it_until_that_failed() -> None:
    def chosen(cuda: bool, **asked: bool) -> str:
        return str(device_of(SimpleNamespace(has_cuda=cuda, Device=SimpleNamespace(cpu="cpu", cuda="cuda")), asked))

    assert [chosen(False), chosen(True), chosen(True, on_cpu=True)] == ["cpu", "cuda", "cpu"]


# -- output folders ----------------------------------------------------------------------------------------------------
def test_out_must_not_overlap_the_folder_of_photographs(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for out in (photos, photos / "capture", tmp_path):
        with pytest.raises(RunError, match="must not be inside or above the folder of the photographs"):
            check_out(out, photos, overwrite=True)
    check_out(tmp_path / "capture", photos, overwrite=False)


def test_a_folder_with_other_files_is_never_replaced(tmp_path: Path) -> None:
    out = tmp_path / "capture"
    out.mkdir()
    check_out(out, tmp_path / "photos", overwrite=False)  # empty
    for name in ("poses.json", "images", "sparse"):
        (out / name).mkdir()
    with pytest.raises(RunError, match="already holds a capture; replace it with --overwrite"):
        check_out(out, tmp_path / "photos", overwrite=False)
    check_out(out, tmp_path / "photos", overwrite=True)
    (out / "thesis.tex").touch()
    with pytest.raises(RunError, match=r"holds other files \(thesis.tex\)"):
        check_out(out, tmp_path / "photos", overwrite=True)
    (out / "thesis.tex").unlink()
    (out / "poses.json").rmdir()  # images and sparse belong to another tool
    with pytest.raises(RunError, match=r"holds other files \(images\)"):
        check_out(out, tmp_path / "photos", overwrite=True)
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="must be a folder"):
        check_out(tmp_path / "file", tmp_path / "photos", overwrite=True)


def test_a_capture_replaces_an_older_one_atomically(tmp_path: Path) -> None:
    out = tmp_path / "room"
    for content in ("first", "second"):
        with workspace(out) as work:
            (work / "capture").mkdir()
            (work / "capture" / "poses.json").write_text(content)
            put_in_place(work / "capture", out, work)
        assert (out / "poses.json").read_text() == content
        assert [path.name for path in tmp_path.iterdir()] == ["room"]


def test_an_older_capture_is_restored_after_a_kill(tmp_path: Path) -> None:
    """Killed between the two renames of put_in_place."""
    left = tmp_path / ".room.poses"
    (left / "old").mkdir(parents=True)
    (left / "old" / "poses.json").write_text("mine")
    (left / "capture" / "images").mkdir(parents=True)
    (left / "database.db").touch()
    with workspace(tmp_path / "room") as work:
        assert [path.name for path in work.iterdir()] == [".lock"]
    assert (tmp_path / "room" / "poses.json").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["room"]


def test_two_commands_cannot_create_the_same_capture(tmp_path: Path) -> None:
    work = tmp_path / ".room.poses"
    work.mkdir()
    with (
        RunFolder(work).locked(),
        pytest.raises(RunError, match="is being created by another process"),
        workspace(tmp_path / "room"),
    ):
        raise AssertionError("both have it")
    assert work.is_dir()  # belongs to the other search
