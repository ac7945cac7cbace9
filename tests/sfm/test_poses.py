"""``gs2d poses`` from images to a capture: COLMAP on a rendered room with known cameras, and on real castles."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cli_runs import one_line
from gs2d.cli import run
from gs2d.core.camera import look_at
from gs2d.core.similarity import apply, similarity_scale, umeyama
from gs2d.data import load_scene
from gs2d.data.image_files import read_image
from gs2d.data.readers.colmap import read_images
from gs2d.pipeline.prepare.options import PosesOptions
from gs2d.pipeline.prepare.pose_finding import find_poses
from gs2d.training.events import Event, Notice, Phase
from room_photos import FOCAL, SIZE, UP, Room, room_image, textures, write_room

ONE_LENS = ("--camera-model", "SIMPLE_PINHOLE")  # no step that adjusts the lens


def poses(photos: Path, out: Path, *words: str) -> int:
    return run(["poses", str(photos), "--out", str(out), "--threads", "2", *words])


def pose_errors(mine: dict[str, np.ndarray], truth: dict[str, np.ndarray]) -> tuple[float, float, np.ndarray]:
    """Return the rms centre error relative to the spread, the largest angle in degrees, and the rotation [3, 3]."""
    names = sorted(mine.keys() & truth.keys())
    centers, targets = (np.stack([-of[n][:3, :3].T @ of[n][:3, 3] for n in names]) for of in (mine, truth))
    T = umeyama(centers, targets)
    R = T[:3, :3] / similarity_scale(T)
    off = np.linalg.norm(apply(T, centers) - targets, axis=1)
    spread = np.linalg.norm(targets - targets.mean(axis=0), axis=1).mean()
    cosines = [(np.trace(mine[n][:3, :3] @ R.T @ truth[n][:3, :3].T) - 1) / 2 for n in names]
    return float(np.sqrt((off**2).mean()) / spread), float(np.degrees(np.arccos(np.clip(min(cosines), -1, 1)))), R


def poses_of(capture: Path) -> dict[str, np.ndarray]:
    return {image.name: image.T_cam_world for image in read_images(capture / "sparse/0", "bin")}


def test_cameras_of_a_rendered_room_are_estimated(room: Room) -> None:
    """Includes rotated images. Measured: centres 0.06 % of their spread, 0.04 degrees, focal length 0.1 %."""
    truth = {name: camera.T_cam_world for name, camera in room.cameras.items()}
    mine = poses_of(room.capture)
    assert mine.keys() == truth.keys()
    centers, degrees, R = pose_errors(mine, truth)
    assert centers < 0.005
    assert degrees < 0.3
    tilt = np.degrees(np.arccos(np.clip((R @ [0, 0, 1]) @ UP, -1, 1)))
    assert tilt < 2.0  # the capture's +z is up
    assert room.printed["cameras"][0]["focal_px"] == pytest.approx(FOCAL, rel=0.01)


def test_the_capture_has_the_files_that_training_reads(room: Room) -> None:
    assert sorted(path.name for path in room.capture.iterdir()) == ["images", "poses.json", "poses.png", "sparse"]
    assert sorted(path.name for path in (room.capture / "sparse").iterdir()) == ["0"]
    assert [path.name for path in room.capture.parent.iterdir()] == ["room"]  # no working folder remains
    scene = load_scene(room.capture)
    assert (scene.format, len(scene.train), len(scene.test)) == ("colmap", 10, 2)
    assert scene.points is not None
    assert len(scene.points) == room.printed["points"] > 500
    image = read_image(room.capture / "poses.png")
    assert image.shape[0] > 300
    assert (np.ptp(image.astype(int), axis=2) > 60).sum() > 500  # red cameras


def test_separate_models_and_unplaced_photographs_are_reported(
    colmap: None, pieces: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "capture"
    assert poses(pieces, out, *ONE_LENS) == 0
    text = capsys.readouterr()
    assert "5 of 10 photographs placed" in text.out
    assert "no camera: 010.jpg: in a separate model (sparse/1)" in text.out
    assert "no camera: blank.jpg: 0 features: blurred, or without texture" in text.out
    assert "sparse/1 holds a separate piece: 4 photographs" in text.out
    assert "photographs" in text.err
    assert load_scene(out).notes[0].startswith("using the model sparse/0 with 5 images; 1 has 4. To use another")


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes(colmap: None, pieces: Path, tmp_path: Path) -> None:
    out = tmp_path / "capture"
    assert poses(pieces, out, "--quiet", *ONE_LENS) == 0
    models = {path: path.read_bytes() for path in sorted(out.rglob("*.bin"))}
    assert len(models) == 10  # cameras, images, points3D, rigs, frames, twice
    assert poses(pieces, out, "--overwrite", "--quiet", *ONE_LENS) == 0
    assert {path: path.read_bytes() for path in sorted(out.rglob("*.bin"))} == models


class Events:
    """Records phases and notices of a search, and interrupts it at the phase ``interrupt_at``."""

    def __init__(self, interrupt_at: str = "") -> None:
        self.phases: list[str] = []
        self.lines: list[str] = []
        self.interrupt_at = interrupt_at

    def __call__(self, event: Event) -> None:
        if isinstance(event, Phase):
            self.phases.append(event.name)
            if event.name == self.interrupt_at:
                raise KeyboardInterrupt
        if isinstance(event, Notice):
            self.lines.append(event.text)


def blank(root: Path) -> None:
    for i in range(3):
        Image.fromarray(np.full((128, 128, 3), 40 * i + 50, np.uint8)).save(root / f"{i}.png")


def strangers(root: Path) -> None:
    for i in range(3):
        write_room(root, 1, seed=i, start=i)


@pytest.mark.parametrize(
    ("write", "expected"),
    [
        (blank, "must hold photographs with texture, got 0 features in the median photograph"),
        (strangers, "must hold photographs that overlap, got 3 without a single matching pair"),
    ],
)
def test_photographs_without_a_model_are_a_one_line_error(
    colmap: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], write: Callable[[Path], None], expected: str
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    write(photos)
    assert poses(photos, tmp_path / "new" / "capture", "--quiet", "--matching", "sequential") == 2
    assert re.search(expected, one_line(capsys.readouterr().err))
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_a_camera_that_only_rotated_gives_a_warning(
    colmap: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """COLMAP finds a model, but with a wrong focal length and 3 degrees between rays; the room has 40."""
    for i in range(4):
        target = np.array([0.0, 0.9 - 0.25 * i, 0.9])
        camera = look_at(np.array([2.5, 2.0, 1.2]), target, UP, width=SIZE, height=SIZE, fx=FOCAL)
        (tmp_path / "photos").mkdir(exist_ok=True)
        Image.fromarray(room_image(camera, textures())).save(tmp_path / "photos" / f"{i}.png")
    assert poses(tmp_path / "photos", tmp_path / "capture", "--matching", "similar", "--set", "overlap=1") == 0
    assert "photographs" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("phase", "kept"),
    [
        ("matching pairs", "features of 12 photographs, [0-9]+ pairs"),  # the worker goes on matching until stopped
        ("adjusting the lens", "features of 12 photographs, 66 pairs, placed cameras"),
    ],
)
def test_an_interrupted_search_continues_and_gives_the_same_bytes(
    room: Room, tmp_path: Path, phase: str, kept: str
) -> None:
    out = tmp_path / "new" / "capture"
    options = PosesOptions(photos=room.photos, out=out, threads=2)
    with pytest.raises(KeyboardInterrupt):
        find_poses(options, first := Events(interrupt_at=phase))
    work = tmp_path / "new" / ".capture.poses"
    assert first.lines[-1].startswith(f"intermediate results are kept in {work}")
    assert [path.name for path in out.parent.iterdir()] == [".capture.poses"]
    find_poses(options, second := Events())
    assert any(re.fullmatch(f"continuing the interrupted search: {kept}", line) for line in second.lines)
    assert [path.name for path in out.parent.iterdir()] == ["capture"]
    for name in ("cameras", "images", "points3D", "frames", "rigs"):
        same = f"sparse/0/{name}.bin"
        assert (out / same).read_bytes() == (room.capture / same).read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=["term", "kill"])
def test_an_interrupted_command_leaves_no_process_and_can_continue(room: Room, tmp_path: Path, number: int) -> None:
    """The worker ends when its stdin closes."""
    words = [sys.executable, "-m", "gs2d", "poses", str(room.photos), "--out", str(tmp_path / "capture")]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    work = tmp_path / ".capture.poses"
    deadline = time.monotonic() + 600
    while not (work / "database.db").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(number)
    _, error = process.communicate(timeout=600)
    if number == signal.SIGTERM:
        assert process.returncode == 130
        assert error.splitlines()[-1] == "interrupted"
    assert [path.name for path in tmp_path.iterdir()] == [".capture.poses"]
    while workers_of(work) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not workers_of(work)
    assert poses(room.photos, tmp_path / "capture", "--quiet") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["capture"]


def workers_of(work: Path) -> list[int]:
    """Return processes whose command line names a file of the working folder (Linux; empty elsewhere)."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if os.fsencode(work) in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
        except OSError:
            continue
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "most_centers", "most_degrees"), [([], 0.004, 0.35), (["--camera-model", "SIMPLE_RADIAL"], 0.002, 0.1)]
)
def test_the_cameras_of_a_castle_agree_with_a_known_model(
    colmap: None,
    shared: Callable[[str], Path],
    tmp_path: Path,
    words: list[str],
    most_centers: float,
    most_degrees: float,
) -> None:
    """11 images with EXIF. The known model has a SIMPLE_RADIAL lens; measured 0.16 %, 0.18 degrees for OPENCV."""
    root = shared("sceaux_castle")
    assert poses(root / "images", tmp_path / "capture", "--quiet", *words) == 0
    known = {image.name: image.T_cam_world for image in read_images(root / "sparse/0", "bin")}
    mine = poses_of(tmp_path / "capture")
    assert len(mine) == 11
    centers, degrees, _ = pose_errors(mine, known)
    assert centers < most_centers
    assert degrees < most_degrees
