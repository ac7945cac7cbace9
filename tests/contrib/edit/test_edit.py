"""``gs2d edit``: kept and deleted boxes, merged and moved splats, undo."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ball_runs import options
from gs2d import Splats, rasterize, read_splats, write_splats
from gs2d.cli import run as gs2d
from gs2d.contrib.edit import edit_splats as module
from gs2d.contrib.edit.edit_command import EditOptions
from gs2d.contrib.edit.edit_splats import edit
from gs2d.errors import RunError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.train.train_run import train
from splat_scenes import a_scene
from tiny import ball_cameras, write_capture

BOX = (-0.5, -2.0, -2.0, 0.6, 2.0, 2.0)
TURN = (2.0, 20.0, -35.0, 110.0, 0.5, -1.0, 3.0)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("data") / "ball")


@pytest.fixture(scope="module")
def undisturbed(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return train(options(capture, tmp_path_factory.mktemp("runs") / "undisturbed"))


@pytest.fixture
def copy(undisturbed: RunFolder, tmp_path: Path) -> RunFolder:
    return RunFolder(Path(shutil.copytree(undisturbed.path, tmp_path / "run")))


def rows_of(splats: Splats) -> list[bytes]:
    """Return the bits of each splat, sorted."""
    columns = [tensor.flatten(1) if tensor.ndim > 1 else tensor[:, None] for _, tensor in splats.items()]
    return sorted(row.tobytes() for row in torch.cat(columns, dim=1).numpy())


def test_kept_and_deleted_splats_are_all_and_keep_their_bits(tmp_path: Path) -> None:
    write_splats(tmp_path / "all.ply", a_scene())
    for name in ("keep", "delete"):
        box = [str(value) for value in BOX]
        words = ["edit", str(tmp_path / "all.ply"), f"--{name}-box", *box, "--out", str(tmp_path / f"{name}.ply")]
        assert gs2d([*words, "--quiet"]) == 0
    kept, others = (read_splats(tmp_path / f"{name}.ply") for name in ("keep", "delete"))
    low, high = torch.tensor(BOX).reshape(2, 3)
    assert ((kept.means >= low) & (kept.means <= high)).all()
    assert not ((others.means >= low) & (others.means <= high)).all(dim=1).any()
    assert rows_of(kept.followed_by(others)) == rows_of(a_scene())


def test_edits_of_a_run_are_undone_byte_for_byte(copy: RunFolder) -> None:
    states = [copy.file("splats.ply").read_bytes()]
    for box in (BOX, (-0.5, -2.0, -2.0, 0.2, 2.0, 2.0)):
        result = edit(copy.path, EditOptions(keep_box=box))
        assert len(read_splats(copy.file("splats.ply"))) == result["splats"] < result["before"]
        states.append(copy.file("splats.ply").read_bytes())
    for state in states[-2::-1]:
        edit(copy.path, EditOptions(undo=True))
        assert copy.file("splats.ply").read_bytes() == state
    assert not copy.file("edits").exists()
    with pytest.raises(RunError, match="no edit to undo"):
        edit(copy.path, EditOptions(undo=True))


def test_files_made_from_other_splats_are_named(copy: RunFolder) -> None:
    for number, name in enumerate(("splats.ply", "mesh.ply", "report.html")):
        os.utime(copy.file(name), (1000 + number, 1000 + number))
    copy.file("scene.html").unlink(missing_ok=True)
    (text,) = edit(copy.path, EditOptions(keep_box=BOX))["notes"]
    assert text.startswith("mesh.ply, report.html, verdict.json: made from other splats; make again: ")
    assert text.endswith(f"gs2d mesh {copy.path}; gs2d evaluate {copy.path}")
    copy.file("mesh.ply").write_bytes(copy.file("mesh.ply").read_bytes())  # as `gs2d mesh` does
    (text,) = edit(copy.path, EditOptions(undo=True))["notes"]
    assert text.startswith("mesh.ply: made from other splats")


def test_a_killed_edit_leaves_the_splats_and_nothing_to_undo(copy: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    before = copy.file("splats.ply").read_bytes()

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    for link in (os.link, stop_link):
        with monkeypatch.context() as patch:
            patch.setattr(os, "link", link)
            patch.setattr(module.splat_ply, "write_splats", stop)
            with pytest.raises(KeyboardInterrupt):
                edit(copy.path, EditOptions(keep_box=BOX))
        assert copy.file("splats.ply").read_bytes() == before
        assert copy.file("edits/0001.ply").read_bytes() == before
    with pytest.raises(RunError, match="no edit to undo"):
        edit(copy.path, EditOptions(undo=True))
    edit(copy.path, EditOptions(keep_box=BOX))
    assert [path.name for path in copy.file("edits").iterdir()] == ["0001.ply"]


def stop_link(*_: object) -> None:
    raise OSError("this file system has no links")


def test_an_edited_run_is_not_resumed_but_replaced(capture: Path, copy: RunFolder) -> None:
    edit(copy.path, EditOptions(keep_box=BOX))
    edited = copy.file("splats.ply").read_bytes()
    with pytest.raises(RunError, match="--undo"):
        train(replace(options(capture, copy.path), resume=True))
    assert copy.file("splats.ply").read_bytes() == edited
    copy.clear()
    assert not copy.file("edits").exists()


@pytest.mark.parametrize("degrees", [(1, 3), (3, 0)])
def test_merged_splats_keep_their_bits_and_the_lower_sh_degree_is_filled_with_zeros(
    tmp_path: Path, degrees: tuple[int, int]
) -> None:
    parts = [a_scene(50, degree, seed) for seed, degree in enumerate(degrees)]
    for number, part in enumerate(parts):
        write_splats(tmp_path / f"{number}.ply", part)
    result = edit(tmp_path / "0.ply", EditOptions(merge=tmp_path / "1.ply"), tmp_path / "both.ply")
    assert "SH degrees" in result["notes"][0]
    both = read_splats(tmp_path / "both.ply")
    for part, rows in zip(parts, (slice(50), slice(50, 100)), strict=True):
        for name, tensor in part.items():
            merged = dict(both.items())[name][rows]
            assert torch.equal(merged[:, : tensor.shape[1]] if name == "shN" else merged, tensor), name
        assert not both.shN[rows, part.shN.shape[1] :].any()


def test_moved_splats_look_the_same_from_a_moved_camera(tmp_path: Path) -> None:
    splats = a_scene(200)
    splats.means[:] = 0.3 * (splats.means - 1)
    splats.log_scales[:] += 2
    write_splats(tmp_path / "a.ply", splats)
    edit(tmp_path / "a.ply", EditOptions(transform=TURN), tmp_path / "b.spz.ply")
    moved = read_splats(tmp_path / "b.spz.ply")
    scale, angles, shift = TURN[0], TURN[1:4], np.array(TURN[4:])
    x, y, z = (
        Rotation.from_rotvec(np.radians(a) * axis).as_matrix() for a, axis in zip(angles, np.eye(3), strict=True)
    )
    R = z @ y @ x
    camera = ball_cameras(1, 48)[0]
    T = np.eye(4)
    T[:3, :3] = camera.rotation @ R.T
    T[:3, 3] = -T[:3, :3] @ (scale * R @ camera.center + shift)
    pictures = [rasterize(splats, camera).color, rasterize(moved, replace(camera, T_cam_world=T)).color]
    assert pictures[0].std() > 0.1
    assert (pictures[0] - pictures[1]).abs().max() < 2e-3


def test_splats_of_another_run_are_moved_and_merged(copy: RunFolder, tmp_path: Path) -> None:
    splats = read_splats(copy.file("splats.ply"))
    back = (0.5, 0.0, 0.0, -90.0, 1.0, 2.0, 3.0)
    there = (2.0, 0.0, 0.0, 90.0, 4.0, -2.0, -6.0)  # the inverse
    edit(copy.path, EditOptions(transform=there), tmp_path / "other.ply")
    result = edit(copy.path, EditOptions(merge=tmp_path / "other.ply", transform=back))
    both = read_splats(copy.file("splats.ply"))
    assert len(both) == result["splats"] == 2 * len(splats)
    assert (both.means[len(splats) :] - splats.means).abs().max() < 1e-5
    assert (both.shN[len(splats) :] - splats.shN).abs().max() < 1e-5
    edit(copy.path, EditOptions(undo=True))
    assert rows_of(read_splats(copy.file("splats.ply"))) == rows_of(splats)


def test_a_wrong_edit_is_one_line_and_changes_nothing(
    copy: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, all_of_it = str(copy.file("splats.ply")), "-9 -9 -9 9 9 9".split()
    cases: dict[tuple[str, ...], str] = {
        ("RUN",): "got none",
        ("RUN", "--undo", "--merge", file): "got --merge and --undo",
        ("RUN", "--keep-box", *"5 5 5 6 6 6".split()): "--keep-box contains none",
        ("RUN", "--keep-box", *"1 0 0 0 1 1".split()): "--keep-box must be a lower",
        ("RUN", "--keep-box", *all_of_it): "changes none",
        ("RUN", "--delete-box", *all_of_it): "--delete-box contains all",
        ("RUN", "--transform", *"1 0 0 9 0 0 0".split()): "away from the cameras",
        ("RUN", "--transform", *"0 0 0 9 0 0 0".split(), "--out", str(tmp_path / "x.ply")): "a positive scale",
        ("RUN", "--transform", *"nan 0 0 9 0 0 0".split(), "--out", str(tmp_path / "x.ply")): "a positive scale",
        ("RUN", "--keep-box", *all_of_it, "--out", file): "splats of the run",
        ("RUN", "--undo"): "no edit to undo",
        ("RUN", "--undo", "--out", str(tmp_path / "x.ply")): "--undo restores",
        (file, "--keep-box", *all_of_it): "name another one with --out",
        (file, "--keep-box", *all_of_it, "--out", str(tmp_path / "x.fbx")): "--out must end in",
        ("RUN", "--merge", str(tmp_path)): "expected a run folder",
    }
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for words, expected in cases.items():
        assert gs2d(["edit", *(str(copy.path) if word == "RUN" else word for word in words)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert expected in line, line
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
