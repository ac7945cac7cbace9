"""``gs2d reconstruct``: from images to a run; refused input, kept results, and resuming without repeated work."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from cli_runs import TINY, one_line
from gs2d.cli import commands, run
from gs2d.cli.parser import parse
from gs2d.io.run_dir import open_run
from gs2d.pipeline import reconstruct as module
from gs2d.pipeline.prepare.options import ReconstructOptions, Training, values
from gs2d.pipeline.reconstruct import poses_options, reconstruct, train_options
from gs2d.training.events import Event, Notice
from room_photos import Room, write_room
from tiny import write_capture

SMALL = {"threads": 1, "quality": "draft", "schedule_scale": 0.0005, "downscale": 8}
FEW_SPLATS = ("init_points=100", "surface.densify.max_splats=150")


def words_for(photos: Path, out: Path, *words: str) -> list[str]:
    return ["reconstruct", str(photos), "--out", str(out), "--threads", "1", "--downscale", "8", *TINY, *words]


def started(room: Room, tmp_path: Path) -> Path:
    """Return a run folder whose poses are already estimated."""
    out = tmp_path / "run"
    shutil.copytree(room.capture, out / "capture")
    return out


def notices(options: ReconstructOptions) -> list[str]:
    heard: list[Event] = []
    reconstruct(options, heard.append)
    return [event.text for event in heard if isinstance(event, Notice)]


def test_photographs_become_a_run_with_its_capture(
    room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "runs" / "a room"
    assert run(words_for(room.photos, out)) == 0
    output = capsys.readouterr()
    assert "photographs" in output.err
    assert "--downscale" in output.err
    assert re.search(r"the run will take about \d+ s", output.err)
    assert output.out.splitlines()[-1] == f"look at it: open scene.html in a browser, or gs2d view '{out}'"
    assert (out / "scene.html").exists()
    assert {"capture", "splats.ply", "mesh.ply", "report.html"} <= {path.name for path in out.iterdir()}
    assert sorted(path.name for path in (out / "capture").iterdir()) == ["images", "poses.json", "poses.png", "sparse"]
    definition = open_run(out).definition()
    assert definition["scene"]["path"] == str((out / "capture").resolve())
    assert (definition["scene"]["train"], definition["scene"]["test"]) == (12, 0)  # few views: all are for training
    assert run(["render", str(out), "--split", "train", "--quiet"]) == 0  # later commands find the capture
    # completed work is not repeated, and the image folder is no longer needed
    finished = (out / "splats.ply").read_bytes()
    assert run([*words_for(room.photos, out, "--resume", "--json", "--quiet")]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["poses"]["placed"] == 12
    assert (out / "splats.ply").read_bytes() == finished


def test_estimated_cameras_are_reused(room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = started(room, tmp_path)
    monkeypatch.setattr(module, "find_poses", lambda *_: pytest.fail("cameras were looked for again"))
    options = ReconstructOptions(photos=room.photos, out=out, resume=True, overrides=FEW_SPLATS, **SMALL)  # type: ignore[arg-type]
    texts = notices(options)
    assert any(text.startswith(f"using the cameras in {out / 'capture'}: 12 of 12") for text in texts)
    assert (out / "mesh.ply").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--set", "feature_size=1000"], "resume"),
        (["--set", "cameras=one"], "made"),
        (["--seed", "3"], "made"),
    ],
)
def test_a_resume_with_other_camera_options_is_an_error(
    room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    out = started(room, tmp_path)
    assert run(words_for(room.photos, out, "--resume", "--quiet", *words)) == 2
    assert message in one_line(capsys.readouterr().err)


def test_a_resume_with_other_photographs_is_an_error(
    room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, photos = started(room, tmp_path), tmp_path / "photos"
    shutil.copytree(room.photos, photos)
    assert run(words_for(photos, out, "--resume", "--quiet")) == 2
    assert "was made with other options (photos: " in one_line(capsys.readouterr().err)
    poses = json.loads((out / "capture" / "poses.json").read_text())
    (out / "capture" / "poses.json").write_text(json.dumps({**poses, "photos": str(photos)}))
    (photos / "003.jpg").rename(photos / "new.jpg")
    assert run(words_for(photos, out, "--resume", "--quiet")) == 2
    assert "003.jpg is missing from" in one_line(capsys.readouterr().err)
    (out / "capture" / "poses.json").write_text("{}")
    assert run(words_for(photos, out, "--resume", "--quiet")) == 2
    assert "reconstruct" in one_line(capsys.readouterr().err)


def nothing(_photos: Path) -> None: ...


def a_capture(photos: Path) -> None:
    write_capture(photos, train=3, test=1, size=20)
    for i, path in enumerate(photos.rglob("*.png")):
        shutil.copy(path, photos / f"{i}.png")


@pytest.mark.parametrize(
    ("fill", "words", "message"),
    [
        (nothing, [], "photographs"),
        (lambda photos: write_room(photos, 1), [], "photographs"),
        (a_capture, [], "photographs"),
        (lambda photos: (photos / "a.heic").write_bytes(b"x"), [], "convert"),
        (lambda photos: write_room(photos, 3), ["--schedule-scale", "0"], "schedule"),
        (lambda photos: write_room(photos, 3), ["--downscale", "0"], "number"),
        (lambda photos: write_room(photos, 3), ["--test-every", "1"], "--test-every must be 0"),
        (lambda photos: write_room(photos, 3), ["--recipe", "3dgs"], "no recipe '3dgs'"),
        (lambda photos: write_room(photos, 3), ["--protocol", "x"], "protocol must be one of"),
        (lambda photos: write_room(photos, 3), ["--set", "cache=/dev/null/x"], "cannot write /dev/null/x"),
        (lambda photos: write_room(photos, 3), ["--set", "max_size=3"], "number"),
    ],
)
def test_bad_input_is_an_error_before_files_are_written(
    colmap: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], fill: Any, words: list[str], message: str
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    fill(photos)
    words_of_command = ["reconstruct", str(photos), "--out", str(tmp_path / "run"), "--quiet", *words]
    assert run(words_of_command) == 2
    assert message in one_line(capsys.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


@pytest.mark.parametrize(
    ("package", "words", "message"),
    [("pycolmap", [], "pip install 'pycolmap>="), ("xatlas", ["--texture"], "pip install 'xatlas>=")],
)
def test_a_missing_extra_is_an_error_before_files_are_written(
    package: str,
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_room(tmp_path / "photos", 3)
    monkeypatch.setitem(sys.modules, package, None)
    if package == "pycolmap":
        monkeypatch.setattr("gs2d.sfm.colmap_process.importlib.util.find_spec", lambda _name: None)
    assert run(words_for(tmp_path / "photos", tmp_path / "run", "--quiet", *words)) == 2
    assert message in one_line(capsys.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_overwrite_starts_again_and_a_failure_keeps_the_old_run(
    room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = started(room, tmp_path)
    assert run(words_for(room.photos, out, "--resume", "--quiet")) == 0
    mesh = (out / "mesh.ply").read_bytes()
    (out / "capture").rename(tmp_path / "elsewhere")
    assert run(words_for(room.photos, out, "--resume", "--quiet")) == 2
    assert "reconstruct" in one_line(capsys.readouterr().err)
    (tmp_path / "elsewhere").rename(out / "capture")
    assert run(words_for(room.photos, out, "--quiet")) == 2
    assert "--resume" in one_line(capsys.readouterr().err)
    photos = tmp_path / "other"
    write_room(photos, 2)
    (photos / "001.png").write_bytes(b"no picture")
    assert run(words_for(photos, out, "--overwrite", "--quiet")) == 2
    assert "001.png" in one_line(capsys.readouterr().err)
    assert (out / "mesh.ply").read_bytes() == mesh
    assert json.loads((out / "capture" / "poses.json").read_text())["photos"] == str(room.photos)


def interrupt(words: list[str], until: str) -> str:
    """Send Ctrl-C when a phase is reported; return stderr."""
    with subprocess.Popen([sys.executable, "-m", "gs2d", *words], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        error_output = ""
        for line in process.stderr:
            error_output += line
            if line.startswith(until):
                time.sleep(0.3)
                process.send_signal(signal.SIGINT)
                break
        error_output += process.stderr.read()
    assert process.returncode == 130, error_output
    assert "Traceback" not in error_output
    return error_output


def test_ctrl_c_during_the_search_keeps_results(room: Room, tmp_path: Path) -> None:
    out = tmp_path / "run"
    error_output = interrupt(words_for(room.photos, out), "finding features")
    line = error_output.splitlines()[-1]
    assert line.startswith("interrupted; resume with: gs2d reconstruct ")
    assert error_output.splitlines()[-1].endswith(" --resume")
    assert [path.name for path in out.iterdir()] == [".capture.poses"]
    heard: list[Event] = []
    options = ReconstructOptions(photos=room.photos, out=out, resume=True, overrides=FEW_SPLATS, **SMALL)  # type: ignore[arg-type]
    reconstruct(options, heard.append)
    lines = [event.text for event in heard if isinstance(event, Notice)]
    assert any(line.startswith("continuing the interrupted search: features of ") for line in lines)
    assert not (out / ".capture.poses").exists()


def test_ctrl_c_during_training_keeps_the_cameras(room: Room, tmp_path: Path) -> None:
    out = started(room, tmp_path)
    words = [*words_for(room.photos, out, "--resume"), "--schedule-scale", "1.0"]
    error_output = interrupt(words, "training 2dgs-r")
    assert error_output.splitlines()[-1].endswith(" --resume")
    assert {"capture", "checkpoints"} <= {path.name for path in out.iterdir()}


def test_every_option_of_train_is_one_of_reconstruct() -> None:
    """Except those that `reconstruct` sets itself; new options of `Training` are added automatically."""
    words = [
        "--recipe",
        "2dgs",
        "--learn",
        "exposure",
        "--test-every",
        "5",
        "--set",
        "init_points=9",
        "--set",
        "cameras=each",
    ]
    command = parse(["reconstruct", "photos", "--out", "run", *words])
    assert isinstance(command, commands.ReconstructCommand)
    training = train_options(command)
    assert values(Training, training) == values(Training, command)
    assert (training.recipe, training.test_every, training.learned) == ("2dgs", 5, ("exposure",))
    assert poses_options(command).cameras == "each"
