"""Pieces that share photographs become one; cameras that are mounted together. On COLMAP's own synthetic matches."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gs2d.core.camera import Camera
from gs2d.data.readers.colmap import read_images
from gs2d.pipeline.prepare.options import PosesOptions
from gs2d.pipeline.prepare.pose_finding import find_poses
from gs2d.sfm.assemble import merged
from room_photos import room_cameras, room_image, textures

COUNT = 14
Part = Callable[[slice], Any]


@pytest.fixture(scope="module")
def pycolmap(colmap: None) -> Any:
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    return pycolmap


@pytest.fixture
def made(pycolmap: Any, tmp_path: Path) -> tuple[dict[str, Any], Any, Part]:
    """A request, a model of photographs that see 300 points, and its parts, with the matches in a database."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, COUNT, 300
    database = pycolmap.Database.open(str(tmp_path / "database.db"))
    truth = pycolmap.synthesize_dataset(options, database)
    database.close()
    for image in truth.images.values():
        Image.new("RGB", (truth.camera(1).width, truth.camera(1).height)).save(tmp_path / image.name)

    def part(numbers: slice) -> Any:
        piece = pycolmap.Reconstruction(truth)
        kept = sorted(truth.images)[numbers]
        for number in set(truth.images) - set(kept):
            piece.deregister_frame(piece.image(number).frame_id)
        return piece

    return {"database": str(tmp_path / "database.db"), "images": str(tmp_path)}, truth, part


def join(pycolmap: Any, request: dict[str, Any], pieces: list[Any]) -> tuple[list[Any], list[tuple[int, int]]]:
    return merged(pycolmap, request, pycolmap.IncrementalPipelineOptions(), pieces, threads=1)


def test_pieces_that_share_photographs_become_one_in_the_frame_of_the_larger(
    pycolmap: Any, made: tuple[dict[str, Any], Any, Part]
) -> None:
    request, truth, part = made
    larger, smaller = part(slice(0, 10)), part(slice(6, COUNT))
    smaller.transform(pycolmap.Sim3d(2.5, pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0])))
    pieces, joined = join(pycolmap, request, [larger, smaller])
    assert joined == [(10, 8)]
    assert [piece.num_reg_images() for piece in pieces] == [COUNT]
    assert pieces[0].num_points3D() > 290
    for number, image in truth.images.items():
        mine = pieces[0].image(number).projection_center()
        np.testing.assert_allclose(mine, image.projection_center(), atol=1e-3)


@pytest.mark.parametrize("case", ["too few", "bent"])
def test_pieces_that_do_not_fit_stay_apart(pycolmap: Any, made: tuple[dict[str, Any], Any, Part], case: str) -> None:
    request, _, part = made
    larger, smaller = part(slice(0, 9)), part(slice(7 if case == "too few" else 5, COUNT))
    if case == "bent":
        rng = np.random.default_rng(0)
        for number in smaller.reg_frame_ids():
            pose = smaller.frame(number).rig_from_world
            moved = pycolmap.Rigid3d(pose.rotation, pose.translation + rng.normal(size=3))
            smaller.frame(number).rig_from_world = moved
    pieces, joined = join(pycolmap, request, [larger, smaller])
    assert joined == []
    assert [piece.num_reg_images() for piece in pieces] == [9, smaller.num_reg_images()]


# -- rigs --------------------------------------------------------------------------------------------------------------
def write_rig(root: Path, count: int) -> dict[str, Camera]:
    """Two cameras side by side, 0.25 apart, before the corner of the room; the true cameras by name."""
    walls, true = textures(), {}
    for i, left in enumerate(room_cameras(count)):
        T = left.T_cam_world.copy()
        T[0, 3] -= 0.25
        right = Camera(left.width, left.height, left.fx, left.fy, left.cx, left.cy, T)
        for folder, camera in (("left", left), ("right", right)):
            (root / folder).mkdir(parents=True, exist_ok=True)
            Image.fromarray(room_image(camera, walls)).save(root / folder / f"{i:03}.jpg", quality=95)
            true[f"{folder}/{i:03}.jpg"] = camera
    return true


def test_cameras_of_a_rig_keep_their_distance_and_place_a_photograph_that_shows_nothing(
    colmap: None, tmp_path: Path
) -> None:
    write_rig(tmp_path / "photos", 6)
    Image.fromarray(np.full((200, 200, 3), 90, np.uint8)).save(tmp_path / "photos" / "right" / "003.jpg")
    options = PosesOptions(photos=tmp_path / "photos", out=tmp_path / "capture", threads=1, rig=True)
    found = find_poses(options)
    assert found["placed"] == 12
    poses = {image.name: image.T_cam_world for image in read_images(tmp_path / "capture" / "sparse/0", "bin")}
    between = [poses[f"right/{i:03}.jpg"] @ np.linalg.inv(poses[f"left/{i:03}.jpg"]) for i in range(6)]
    for one in between[1:]:
        np.testing.assert_allclose(one, between[0], atol=1e-9)
