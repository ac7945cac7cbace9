"""Invalid and unsupported camera files of other tools."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from foreign_writers import (
    poses,
    small_alicevision,
    small_metashape,
    small_opensfm,
    write_images,
)
from gs2d.data import load_scene
from gs2d.errors import DataError


def opensfm_with(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def write(root: Path) -> None:
        small_opensfm(root)
        path = root / "reconstruction.json"
        data = json.loads(path.read_text())
        change(data[0])
        path.write_text(json.dumps(data))

    return write


def alicevision_with(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def write(root: Path) -> None:
        small_alicevision(root)
        path = root / "cameras.sfm"
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data))

    return write


def metashape_with(old: str, new: str) -> Callable[[Path], None]:
    def write(root: Path) -> None:
        small_metashape(root)
        path = root / "cameras.xml"
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, 1))

    return write


def cut(writer: Callable[[Path], Any], name: str) -> Callable[[Path], None]:
    def write(root: Path) -> None:
        writer(root)
        path = root / name
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])

    return write


def without_images(writer: Callable[[Path], Any]) -> Callable[[Path], None]:
    def write(root: Path) -> None:
        writer(root)
        for path in (root / "images").iterdir():
            path.unlink()

    return write


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (opensfm_with(lambda d: d["shots"]["a_1.jpg"].update(translation=[0, math.nan, 1])), "a_1.jpg"),
        (
            alicevision_with(lambda d: d["poses"][1]["pose"]["transform"].update(center=["0", "-nan(ind)", "1"])),
            "a_1.jpg",
        ),
        (
            metashape_with(
                "</cameras>", f"<camera id='9' label='z'><transform>{'nan ' * 16}</transform></camera></cameras>"
            ),
            "z",
        ),
    ],
)
def test_an_image_whose_pose_is_not_finite_is_skipped_and_named(
    tmp_path: Path, write: Callable[[Path], None], name: str
) -> None:
    write(tmp_path)
    scene = load_scene(tmp_path)
    assert [line.split(": ")[0] for line in scene.skipped] == [name]
    assert "must be a finite number" in scene.skipped[0]
    assert name not in {Path(view.name).name for view in scene.views}


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (cut(small_opensfm, "reconstruction.json"), r"reconstruction\.json must be JSON, got: .*is the file complete"),
        (lambda root: (small_opensfm(root), (root / "reconstruction.json").write_text("[]")), "got an empty list; did"),
        (lambda root: (small_opensfm(root), (root / "reconstruction.json").write_text("[3]")), "0 must be an object"),
        (opensfm_with(lambda d: d.pop("cameras")), 'must have the key "cameras", got'),
        (opensfm_with(lambda d: d["shots"]["a_1.jpg"].pop("rotation")), 'a_1.jpg must have the key "rotation"'),
        (opensfm_with(lambda d: d["shots"]["a_1.jpg"].update(rotation=[0, 1])), "rotation must be 3 numbers, got 2"),
        (opensfm_with(lambda d: d["shots"]["a_1.jpg"].update(camera="b")), "cameras must hold 'b' of shot a_1.jpg"),
        (opensfm_with(lambda d: d["cameras"]["v2 a b"].update(focal_x=0)), "must have a positive focal length, got 0"),
        (opensfm_with(lambda d: d["cameras"]["v2 a b"].update(k1="x")), "k1 must be a finite number, got 'x'"),
        (opensfm_with(lambda d: d["cameras"]["v2 a b"].update(width=40.5)), "width must be a whole number"),
        (opensfm_with(lambda d: d["points"]["0"].pop("coordinates")), "points must have 3 coordinates"),
        (opensfm_with(lambda d: d["points"]["0"].update(coordinates=[1, 2])), "points must have 3 coordinates"),
        (
            without_images(small_opensfm),
            r"with a camera, got none \(9 skipped, first: a_0.jpg: listed in",
        ),
        (cut(small_metashape, "cameras.xml"), r"cameras\.xml must be XML, got: .*is the file complete"),
        (metashape_with("<cameras", "<!DOCTYPE x><cameras"), "got XML with document type definitions"),
        (metashape_with("chunk", "chunky"), "must be XML, got: mismatched tag"),
        (metashape_with("<f>36.0</f>", ""), "positive size and focal length f, got 40x30, 0; export the cameras with"),
        (metashape_with("<f>36.0</f>", "<f>nan</f>"), "sensor 0: f must be a finite number, got 'nan'"),
        (
            metashape_with("<calibration type='frame'", "<calibration type='cylindrical'"),
            "has the unsupported type cylindrical",
        ),
        (metashape_with("<f>", "<p3>0.1</p3><f>"), "has the coefficients p3 and p4, which are not supported"),
        (metashape_with("sensor_id='0'", "sensor_id='5'"), "must hold sensor '5' of camera a_0, got"),
        (metashape_with("<transform>", "<transform>1 "), "camera a_0: transform must be 16 numbers, got 17"),
        (metashape_with("<scale locked='true'>2.5", "<scale locked='true'>-1"), "scale must be positive, got -1"),
        (without_images(small_metashape), "at least one image with a camera, got none"),
        (cut(small_alicevision, "cameras.sfm"), r"cameras\.sfm must be JSON, got: .*is the file complete"),
        (alicevision_with(lambda d: d.pop("poses")), "must hold poses, got none; use the file of the node Structure"),
        (alicevision_with(lambda d: d.update(version=["1", "2"])), "version must be 3 numbers"),
        (alicevision_with(lambda d: d["views"][1].pop("path")), 'view 1 must have the key "path"'),
        (alicevision_with(lambda d: d["views"][1].update(intrinsicId="7")), "intrinsics must hold 7 of view a_1.jpg"),
        (alicevision_with(lambda d: d["intrinsics"][0].update(type="equidistant")), "is of type equidistant with"),
        (alicevision_with(lambda d: d["intrinsics"][0].update(distortionType="3deradial4")), "distortion 3deradial4"),
        (alicevision_with(lambda d: d["intrinsics"][0].update(focalLength="-1")), "positive size and focal length"),
        (alicevision_with(lambda d: d["intrinsics"][0].update(sensorWidth="0")), "positive sensorWidth and pixelRatio"),
        (
            alicevision_with(lambda d: d["poses"][0]["pose"]["transform"].update(rotation=["2"] * 9)),
            "must hold a rotation, got columns of length",
        ),
        (alicevision_with(lambda d: d["structure"][0].pop("X")), "structure must have X and color"),
        (without_images(small_alicevision), "at least one image with a camera, got none"),
    ],
)
def test_an_invalid_file_is_one_line_that_names_it(tmp_path: Path, write: Callable[[Path], Any], words: str) -> None:
    write(tmp_path)
    with pytest.raises(DataError, match=words) as caught:
        load_scene(tmp_path)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("my.psx", "got the project file my.psx: in Metashape, use File > Export > Export Cameras as Agisoft XML"),
        ("sfm.abc", "got the project file sfm.abc: use cameras.sfm of Meshroom's node"),
        ("scene.RCPROJ", "got the project file scene.RCPROJ: in RealityCapture, export the registration as COLMAP"),
        (
            "a_0.xmp",
            "got 9 images without cameras; `gs2d reconstruct .* --out RUN` makes a run",
        ),  # any photo editor writes such
    ],
)
def test_a_project_of_another_tool_says_what_to_export(tmp_path: Path, name: str, words: str) -> None:
    write_images(tmp_path, poses())
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(DataError, match=words):
        load_scene(tmp_path)
