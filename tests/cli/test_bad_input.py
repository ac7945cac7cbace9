"""Bad input: one line, exit code 2, and nothing left behind."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from capture_writers import small_colmap
from cli_runs import TINY, one_line
from gs2d.cli import run
from tiny import write_capture


def truncated_images_bin(folder: Path) -> None:
    small_colmap(folder)
    path = folder / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes()[:-20])


def unsupported_camera(folder: Path) -> None:
    params = (35.0, 36.0, 18.5, 16.25, *[0.0] * 12)
    small_colmap(folder, cameras={7: ("RAD_TAN_THIN_PRISM_FISHEYE", 40, 30, params)})


def wrong_json_key(folder: Path) -> None:
    write_capture(folder, train=2, test=1)
    path = folder / "transforms_train.json"
    path.write_text(path.read_text().replace("transform_matrix", "transfrom_matrix"))


def broken_json(folder: Path) -> None:
    write_capture(folder, train=2, test=1)
    path = folder / "transforms_train.json"
    path.write_text(path.read_text()[:-40])


def image_that_does_not_decode(folder: Path) -> None:
    write_capture(folder, train=3, test=1)
    path = folder / "train" / "r_2.png"
    path.write_bytes(path.read_bytes()[:100])


def text_for_image(folder: Path) -> None:
    write_capture(folder, train=3, test=1)
    (folder / "train" / "r_1.png").write_text("not a picture")


def cut_json_of_opensfm(folder: Path) -> None:
    folder.mkdir()
    (folder / "reconstruction.json").write_text('[{"cameras": {')


def xml_of_metashape_without_images(folder: Path) -> None:
    folder.mkdir()
    place = "<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>"
    cameras = f"<cameras><camera id='0' sensor_id='0' label='a'>{place}</camera></cameras>"
    (folder / "cameras.xml").write_text(f"<document><chunk><sensors/>{cameras}</chunk></document>")


def meshroom_before_its_poses(folder: Path) -> None:
    folder.mkdir()
    (folder / "cameras.sfm").write_text('{"version": ["1", "2", "6"], "views": [], "intrinsics": []}')


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (cut_json_of_opensfm, "reconstruction.json"),
        (xml_of_metashape_without_images, "listed in cameras.xml"),
        (meshroom_before_its_poses, "StructureFromMotion"),
        (truncated_images_bin, "images.bin"),
        (unsupported_camera, "RAD_TAN_THIN_PRISM_FISHEYE"),
        (wrong_json_key, "transform_matrix"),
        (broken_json, "transforms_train.json"),
        (image_that_does_not_decode, "r_2.png"),
        (text_for_image, "r_1.png"),
    ],
)
def test_a_capture_that_cannot_be_read_gives_one_line_and_exit_code_2_and_leaves_nothing(
    make: Callable[[Path], None], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(tmp_path / "capture")
    before = sorted(tmp_path.rglob("*"))
    words = ["train", str(tmp_path / "capture"), "--out", str(tmp_path / "deep" / "run"), "--quiet", *TINY]
    assert run(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert named in one_line(err)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ('{"min_angle": 34.9}', "viewing directions"),
        ('{"side": 1}', "dense_start.side"),
        ('{"fit": 3}', "dense_start.fit must be true or false"),
    ],
)
def test_a_plane_sweep_without_points_is_a_one_line_error_and_leaves_no_run(
    start: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_capture(tmp_path / "capture")
    out = tmp_path / "run"
    words = ["train", str(tmp_path / "capture"), "--out", str(out), "--quiet", *TINY, "--set", f"dense_start={start}"]
    assert run(words) == 2
    assert message in one_line(capsys.readouterr().err)
    assert not out.exists()


def masked_colmap(folder: Path, black: tuple[int, ...]) -> None:
    """COLMAP's layout with masks, of which some are black; view 0 is the test view."""
    small_colmap(folder, count=3)
    (folder / "masks").mkdir()
    for i in range(3):
        Image.new("L", (40, 30), 0 if i in black else 255).save(folder / "masks" / f"{i}.png")


@pytest.mark.parametrize("black", [(0, 1, 2), (1, 2)])
def test_masks_that_leave_nothing_to_learn_from_are_an_error(
    black: tuple[int, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    masked_colmap(tmp_path / "capture", black)
    assert run(["train", str(tmp_path / "capture"), "--out", str(tmp_path / "run"), "--quiet", *TINY]) == 2
    assert f"the masks of {len(black)} of 3 views leave no pixel" in one_line(capsys.readouterr().err)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--recipe", "3dgs"], "no recipe '3dgs'"),
        (["--set", "appearance.train.sh0=nobody"], "row group 'nobody'"),
        (["--set", "surface.densify.max_splats=0"], "integer"),
        (["--set", "fused_depth=nearest"], "transmittance"),
        (["--protocol", "tanks"], "protocol must be one of"),
        (["--downscale", "0"], "--downscale"),
        (["--downscale", "1000"], "1000"),
        (["--schedule-scale", "-1"], "--schedule-scale must be"),
        (["--format", "colmap"], "colmap"),
        (["--learn", "exposures"], "did you mean exposure?"),
        (["--robust", "perhaps"], "invalid"),
    ],
)
def test_options_that_make_no_sense_give_one_line_and_leave_nothing(
    capture: Path, more: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["train", str(capture), "--out", str(tmp_path / "run"), "--quiet", *TINY, *more]) == 2
    assert named.lower() in one_line(capsys.readouterr().err).lower()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--bbox", "1", "0", "0", "0", "1", "1"], "corner"),
        (["--subject-box", "0", "0", "0", "1", "1", "nan"], "got 0 0 0 1 1 nan"),
        (["--subject-box", "0", "0", "0", "1", "1", "1", "--scene"], "exclude"),
        (["--subject-box", "0", "0", "0", "1", "inf", "1"], "corner"),
        (["--subject-box", "90", "90", "90", "91", "91", "91"], "splats"),
        (["--subject-box", "0", "0", "0", "1", "1", "1", "--method", "unbounded"], "exclude"),
        (["--method", "tsfd"], "--method: mesh method must be one of tsdf, "),
        (["--method", "tsfd", "--texture", "--out", "new.glb"], "'tsfd'; did you mean tsdf?"),
    ],
)
def test_a_box_or_method_that_makes_no_sense_changes_nothing_in_the_run(
    words: list[str], named: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(trained, tmp_path / "run"))
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    assert run(["mesh", str(copy), "--quiet", *words]) == 2
    assert named in one_line(capsys.readouterr().err)
    assert {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()} == before


def test_a_folder_that_holds_a_run_or_something_else_is_kept(
    capture: Path, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (trained / "splats.ply").read_bytes()
    assert run(["train", str(capture), "--out", str(trained)]) == 2
    assert "--resume" in one_line(capsys.readouterr().err)
    assert (trained / "splats.ply").read_bytes() == before
    (tmp_path / "mine.txt").write_text("mine")
    assert run(["train", str(capture), "--out", str(tmp_path), "--overwrite"]) == 2
    assert "mine.txt" in one_line(capsys.readouterr().err)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("name", "old", "new", "command", "code"),
    [
        # The report lacks its images: exit code 3.
        ("renders/index.json", '"camera"', '"cam"', "evaluate", 3),
        ("renders/index.json", '"stages": [', '"stages": 5, "x": [', "evaluate", 3),
        ("metrics.json", '"iterations": ', '"iterations": "x", "y": ', "info", 2),
        ("metrics.json", '"name": "', '"name": [], "x": "', "evaluate", 2),
        ("run.json", '"path": "', '"path": 5, "x": "', "render", 2),
    ],
)
def test_a_damaged_file_of_a_run_is_named(
    name: str,
    old: str,
    new: str,
    command: str,
    code: int,
    trained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    text = (copy / name).read_text()
    assert old in text
    (copy / name).write_text(text.replace(old, new))
    assert run([command, str(copy), "--quiet"]) == code
    error_output = capsys.readouterr().err
    if code == 2:
        assert Path(name).name in one_line(error_output)
    else:
        assert error_output != ""
        assert all(line.startswith("not made: ") and Path(name).name in line for line in error_output.splitlines())
