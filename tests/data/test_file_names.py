"""Image files by the names in camera files of every reader."""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture_writers import small_blender, small_colmap, small_nerfstudio
from foreign_writers import small_alicevision, small_metashape, small_opensfm
from gs2d.data import load_scene
from gs2d.data.file_names import Files
from gs2d.data.image_files import HEIF


def files(root: Path, *names: str) -> None:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def matched(root: Path, *names: str, **options: object) -> list[str | None]:
    found = Files([root]).match([[name] for name in names], **options)  # type: ignore[arg-type]
    return [None if match.path is None else match.path.relative_to(root).as_posix() for match in found]


@pytest.mark.parametrize(
    ("name", "there", "expected"),
    [
        ("a/b.png", ["a/b.png", "b.png"], "a/b.png"),
        ("C:\\Users\\me\\a\\b.png", ["a/b.png", "c/b.png"], "a/b.png"),
        ("/home/me/a/b.png", ["x/b.png"], "x/b.png"),
        ("b.png", ["x/y/b.png"], "x/y/b.png"),
        ("./a//b.PNG", ["A/b.png"], "A/b.png"),
        ("a/b.PNG", ["a/b.png", "a/b.PNG"], "a/b.PNG"),
        ("x/b.PNG", ["a/b.png", "a/b.PNG"], "a/b.PNG"),
        ("b.PNG", ["a/b.png", "a/B.png"], None),
        ("b.png", ["a/b.png", "c/b.png"], None),
        ("b.png", ["b.jpg", "b.png.txt", ".hidden/b.png", "images_4/b.png"], None),
        ("Gr\u00fcn.png", ["Gru\u0308n.png"], "Gru\u0308n.png"),
        ("GRU\u0308N.png", ["a/gr\u00fcn.png"], "a/gr\u00fcn.png"),
        ("", ["b.png"], None),
        ("a\0b.png", ["b.png"], None),
        ("a" * 5000, ["b.png"], None),
    ],
)
def test_the_longest_common_end_of_a_path_selects_the_file(
    tmp_path: Path, name: str, there: list[str], expected: str | None
) -> None:
    files(tmp_path, *there)
    assert matched(tmp_path, name) == [expected]


def renamed(name: str) -> str:
    return unicodedata.normalize("NFD", f"Gr\u00fcn {name}")


#: what happened to a capture between the program that wrote its cameras and this machine
CHANGES: dict[str, Callable[[str], str]] = {
    "moved from Windows": lambda name: f"C:\\Users\\me\\scan\\{name}",
    "moved from Linux": lambda name: f"/home/nobody/scan/{name}",
    "prefix": lambda name: f"images/{name}",
    "names only": lambda name: name,
    "upper case": str.upper,
    "decomposed": lambda name: f"Gr\u00fcn {name}",
}
#: how each format writes names: the writer, the camera files, a photograph's name in them
FORMATS = {
    "colmap": (lambda root: small_colmap(root, kind="txt"), ["sparse/0/images.txt"], "{}"),
    "nerfstudio": (small_nerfstudio, ["transforms.json"], "images/{}"),
    "opensfm": (small_opensfm, ["reconstruction.json"], "{}"),
    "metashape": (small_metashape, ["cameras.xml"], "{}"),
    "alicevision": (small_alicevision, ["cameras.sfm"], "D:\\shots\\{}"),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("format", FORMATS)
def test_every_reader_finds_renamed_images(tmp_path: Path, format: str, change: str) -> None:
    write, cameras, written = FORMATS[format]
    write(tmp_path)
    before = load_scene(tmp_path)
    in_json = cameras[0].endswith((".json", ".sfm"))
    quoted = (lambda text: json.dumps(text)[1:-1]) if in_json else str
    for path in sorted((tmp_path / "images").iterdir()):
        label = path.stem if format == "metashape" else path.name
        old, new = written.format(label), CHANGES[change](path.name)
        for camera_file in (tmp_path / name for name in cameras):
            text, edge = camera_file.read_text(), '"' if in_json else "'" if format == "metashape" else ""
            text = text.replace(edge + quoted(old) + edge, edge + quoted(new) + edge)
            camera_file.write_text(text)
        if change == "decomposed":
            path.rename(path.with_name(renamed(path.name)))
    scene = load_scene(tmp_path)
    assert (len(scene.views), scene.skipped) == (9, ())
    for view, same in zip(scene.views, before.views, strict=True):
        np.testing.assert_array_equal(view.camera.T_cam_world, same.camera.T_cam_world)
        assert view.path.name in (same.path.name, renamed(same.path.name))
    if change != "decomposed":
        assert [view.name for view in scene.views] == [view.name for view in before.views]


def test_blender_finds_images_of_another_machine_in_the_right_split(tmp_path: Path) -> None:
    small_blender(tmp_path)
    for split in ("train", "test"):
        path = tmp_path / f"transforms_{split}.json"
        path.write_text(path.read_text().replace('"./', '"D:/lego/'))
    assert len(load_scene(tmp_path).test) == 2
    for path in (tmp_path / "test").iterdir():
        path.unlink()
    scene = load_scene(tmp_path)
    assert (len(scene.train), len(scene.test), len(scene.skipped)) == (4, 0, 2)


def test_masks_maps_and_points_of_another_machine_are_found(tmp_path: Path) -> None:
    there = {"mask_path": "masks", "depth_file_path": "depths", "normal_file_path": "normals"}
    keys = {key: f"E:\\scan\\{folder}\\f.png" for key, folder in there.items()}
    small_nerfstudio(tmp_path, meta={"ply_file_path": "/data/scan/cloud.ply"}, frame=keys)
    for folder in there.values():
        files(tmp_path, f"{folder}/F.png")
    mask = np.full((30, 40), 255, np.uint8)
    mask[:, :7] = 0
    Image.fromarray(mask).save(tmp_path / "masks" / "F.png")
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "Cloud.ply").write_text(f"{header}end_header\n1 2 3\n4 5 6\n")
    scene = load_scene(tmp_path)
    np.testing.assert_array_equal(scene.train[0].mask(), mask > 0)
    maps = scene.train[0].maps
    assert maps is not None
    assert (maps.files.depth, maps.files.normal) == (tmp_path / "depths" / "F.png", tmp_path / "normals" / "F.png")
    assert scene.points is not None
    np.testing.assert_array_equal(scene.points.points, [[1, 2, 3], [4, 5, 6]])


def test_a_photograph_is_not_its_own_mask_or_depth_map(tmp_path: Path) -> None:
    small_nerfstudio(tmp_path, count=2)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    for frame in meta["frames"]:
        frame["mask_path"] = frame["depth_file_path"] = Path(frame["file_path"]).name
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    scene = load_scene(tmp_path, test_every=0)
    assert [view.maps for view in scene.views] == [None, None]
    assert scene.masks.found == 0
    assert "2 masks named in transforms.json do not exist" in scene.notes
    assert "2 depth maps named in transforms.json do not exist" in scene.notes


@pytest.mark.skipif(bool(HEIF), reason="a package for HEIC is installed")
def test_images_of_unsupported_formats_are_skipped_with_the_reason(tmp_path: Path) -> None:
    small_metashape(tmp_path, labels="{}.HEIC")
    images = sorted((tmp_path / "images").iterdir())
    for path in images[:4]:
        path.with_suffix(".HEIC").write_bytes(b"\0\0\0\x18ftypheic")
        path.unlink()
    for path in images[4:]:
        path.rename(path.with_suffix(".HEIC"))  # JPEG with a wrong extension, which is read
    scene = load_scene(tmp_path)
    assert len(scene.views) == 5
    assert len(scene.skipped) == 4
    assert scene.skipped[0].startswith("a_0.HEIC: HEIC cannot be read; pip install pi-heif")
