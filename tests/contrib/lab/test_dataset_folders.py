"""Data sets as they are distributed, written small: every file that is taken away is named in one line."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from capture_writers import ColmapModel, small_blender, small_colmap, small_dtu, write_image_of
from gs2d.contrib.lab.dataset_folders import find_truth, missing_lines, protocol_of, recognise
from gs2d.contrib.lab.datasets import DATASETS
from gs2d.contrib.lab.scenes import find_scenes
from gs2d.data import detect_format, load_scene


def write_dtu_2dgs(data: Path) -> Path:
    """DTU as 2DGS prepares it, and the official files beside it."""
    root = data / "DTU" / "scan24"
    cameras = small_dtu(root, count=3, images="images", archive="cameras.npz")
    shutil.copy(root / "cameras.npz", root / "cameras_sphere.npz")
    model = ColmapModel(cameras={1: ("PINHOLE", 40, 30, (35.0, 35.0, 20.0, 15.0))})
    model.images = [(i + 1, c.T_cam_world, 1, f"{i:06d}.png", []) for i, c in enumerate(cameras)]
    model.points = [(1, (0.1, 0.2, 0.3), (1, 2, 3), 0.1, [])]
    model.write(root / "sparse/0")
    official = data / "Official_DTU_Dataset"
    (official / "Points/stl").mkdir(parents=True)
    (official / "Points/stl/stl024_total.ply").write_text("ply\n")
    (official / "ObsMask").mkdir()
    savemat(official / "ObsMask/ObsMask24_10.mat", {"ObsMask": np.ones((2, 2, 2), np.uint8)})
    savemat(official / "ObsMask/Plane24.mat", {"P": np.ones((4, 1))})
    return root


def write_dtu_neus(data: Path) -> Path:
    """DTU as NeuS has it; the official archives as they unpack."""
    root = data / "data_DTU" / "dtu_scan65"
    small_dtu(root, count=3)
    (data / "Points/stl").mkdir(parents=True)
    (data / "Points/stl/stl065_total.ply").write_text("ply\n")
    masks = data / "SampleSet/MVS Data/ObsMask"
    masks.mkdir(parents=True)
    (masks / "ObsMask65_10.mat").write_text("")
    (masks / "Plane65.mat").write_text("")
    return root


def write_tnt(data: Path) -> Path:
    """TNT_GOF, and the ground truth of the official site."""
    root = data / "TNT_GOF/TrainingSet/Barn"
    small_colmap(root, count=4)
    (root / "Barn_COLMAP_SfM.log").write_text("")
    truth = data / "TNT_GT/Barn"
    truth.mkdir(parents=True)
    for name in ("Barn.ply", "Barn.json", "Barn_trans.txt", "Barn_COLMAP_SfM.log"):
        (truth / name).write_text("")
    return root


def write_nerf_synthetic(data: Path) -> Path:
    root = data / "nerf_synthetic/lego"
    small_blender(root, train=3, test=2)
    (root / "mesh_gt.ply").write_text("ply\n")
    return root


def write_360(data: Path) -> Path:
    root = data / "360_v2/garden"
    model = small_colmap(root, count=3)
    for image in model.images:
        write_image_of(root / "images_4" / image[3], 10, 8)
    (root / "poses_bounds.npy").write_text("")
    return root


LAYOUTS: dict[str, tuple[str, str, Callable[[Path], Path]]] = {
    "dtu-2dgs": ("dtu", "scan24", write_dtu_2dgs),
    "dtu-neus": ("dtu", "scan65", write_dtu_neus),
    "tnt": ("tnt", "Barn", write_tnt),
    "nerf-synthetic": ("nerf-synthetic", "lego", write_nerf_synthetic),
    "mip-nerf-360": ("mip-nerf-360", "garden", write_360),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_whole_data_set_has_its_scene_and_nothing_missing(tmp_path: Path, layout: str) -> None:
    dataset, name, write = LAYOUTS[layout]
    root = write(tmp_path)
    (scene,) = find_scenes(tmp_path)
    assert (scene.scene, scene.path) == (name, root)
    assert scene.missing == ()
    assert scene.scored == (dataset != "mip-nerf-360")  # which has no true surface
    assert recognise(root) == (DATASETS[dataset], DATASETS[dataset].scene(name))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_whole_data_set_loads(tmp_path: Path, layout: str) -> None:
    root = LAYOUTS[layout][2](tmp_path)
    scene = load_scene(root, downscale=4 if layout == "mip-nerf-360" else 1)
    assert len(scene.views) >= 3
    assert scene.skipped == ()


def files_of(layout: str) -> list[str]:
    """What each writer writes, so that pytest can name every case before anything is written."""
    images = [f"{i:06d}.png" for i in range(3)]
    masks = [f"{i:03d}.png" for i in range(3)]
    model = [f"sparse/0/{stem}.bin" for stem in ("cameras", "images", "points3D")]
    if layout == "dtu-2dgs":
        root, official = "DTU/scan24", "Official_DTU_Dataset"
        truth = ["Points/stl/stl024_total.ply", "ObsMask/ObsMask24_10.mat", "ObsMask/Plane24.mat"]
        capture = [f"images/{p}" for p in images] + [f"mask/{m}" for m in masks] + model
        return [f"{root}/{f}" for f in capture] + [f"{official}/{f}" for f in truth]
    if layout == "dtu-neus":
        capture = [f"image/{p}" for p in images] + [f"mask/{m}" for m in masks] + ["cameras_sphere.npz"]
        mat = [f"SampleSet/MVS Data/ObsMask/{n}" for n in ("ObsMask65_10.mat", "Plane65.mat")]
        return [f"data_DTU/dtu_scan65/{f}" for f in capture] + ["Points/stl/stl065_total.ply", *mat]
    if layout == "tnt":
        names = ("Barn.ply", "Barn.json", "Barn_trans.txt", "Barn_COLMAP_SfM.log")
        capture = [f"images/{i}.png" for i in range(4)] + model + ["Barn_COLMAP_SfM.log"]
        return [f"TNT_GOF/TrainingSet/Barn/{f}" for f in capture] + [f"TNT_GT/Barn/{n}" for n in names]
    if layout == "nerf-synthetic":
        splits = {"train": 3, "test": 2}
        lists = [f"transforms_{split}.json" for split in splits]
        capture = [f"{split}/r_{i}.png" for split, count in splits.items() for i in range(count)]
        return [f"nerf_synthetic/lego/{f}" for f in (*lists, *capture, "mesh_gt.ply")]
    capture = [f"images_4/{i}.png" for i in range(3)]
    return [f"360_v2/garden/{f}" for f in (*model, *capture)]


@pytest.mark.parametrize(("layout", "file"), [(layout, file) for layout in LAYOUTS for file in files_of(layout)])
def test_a_file_that_is_taken_away_is_named_in_one_line(tmp_path: Path, layout: str, file: str) -> None:
    dataset, name, write = LAYOUTS[layout]
    root = write(tmp_path)
    (tmp_path / file).unlink()
    if file.startswith(("Official", "TNT_GT", "Points", "SampleSet")) or "mesh_gt" in file:
        pieces = find_truth(DATASETS[dataset], DATASETS[dataset].scene(name), root)[1]
        lines = tuple(piece.line() for piece in pieces)
        assert all("to score the surface" in line for line in lines)
        assert missing_lines(root) == ()
    else:
        lines = missing_lines(root)
    (line,) = [line for line in lines if _names(line, Path(file).name)]
    assert line.count("\n") == 0
    assert " is missing (" in line
    assert "get it from" in line or "export the object" in line
    lists = file.endswith((".json", ".npz", "images.bin"))  # without a list, its files are not checked
    assert len(lines) == 1 or lists


def _names(line: str, name: str) -> bool:
    return line.split(" is missing")[0].endswith(name)


@pytest.mark.parametrize(
    ("layout", "protocol"),
    [("dtu-neus", "dtu"), ("tnt", "tnt"), ("nerf-synthetic", "nerf-synthetic"), ("mip-nerf-360", "mip-nerf-360")],
)
def test_auto_takes_the_protocol_of_a_known_scene(tmp_path: Path, layout: str, protocol: str) -> None:
    root = LAYOUTS[layout][2](tmp_path)
    assert protocol_of(root, detect_format(root)).name == protocol


def test_an_image_in_another_letter_case_is_not_missing(tmp_path: Path) -> None:
    root = write_360(tmp_path)
    assert missing_lines(root) == ()
    image = min((root / "images_4").iterdir())
    image.rename(image.with_suffix(image.suffix.upper()))
    assert missing_lines(root) == ()
