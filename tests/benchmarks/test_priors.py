"""The captures that say what known depths are worth: what a sensor and a network make of true depths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from benchmarks.prior_captures import of_room, relative_map, room_image, room_mesh, sensor_map, write_maps

from gs2d.core.camera import look_at
from gs2d.data.priors import read_depth, read_normals
from gs2d.meshing.raycast import cast_camera


def test_maps_are_those_of_the_room_spoilt_as_their_sources_spoil_them(tmp_path: Path) -> None:
    mesh, owner = room_mesh()
    eye, target = np.array([-0.4, -0.7, 1.4]), np.array([1.0, 0.2, 0.9])
    camera = look_at(eye, target, np.array([0.0, 0.0, 1.0]), width=192, height=144, fx=150.0)
    depth = cast_camera(mesh.vertices, mesh.faces, camera).depth
    assert (depth > 0).all()  # a room is closed
    for maps in ("sensor", "relative", "normal", "none"):
        (tmp_path / maps).mkdir()
        write_maps(tmp_path / maps, mesh, [("a.png", camera, False), ("b.png", camera, True)], maps, 0)
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.png")) == [
        "normal/normals/a.png",
        "relative/depths/a.png",
        "sensor/depths/a.png",
    ]
    metres = read_depth(tmp_path / "sensor/depths/a.png") / 1000
    valid = metres > 0
    assert metres.shape == (72, 96)
    assert 0.6 < valid.mean() < 0.95
    error = (metres / depth[::2, ::2] - 1)[valid]
    assert 0.008 < error.std() < 0.012
    values = read_depth(tmp_path / "relative/depths/a.png").astype(float)
    assert np.corrcoef(values.ravel(), (1 / depth).ravel())[0, 1] > 0.95
    normals = read_normals(tmp_path / "normal/normals/a.png")
    assert (normals[..., 2] > 0).mean() > 0.9  # OpenGL's z points back
    image = room_image(mesh, owner, camera, np.random.default_rng(0))
    assert image.shape == (144, 192, 3)
    assert image.std() > 10


def test_a_sensor_knows_nothing_of_the_background_and_a_network_neither() -> None:
    depth = np.full((40, 40), 2.0)
    depth[:, :8] = 0
    for make in (sensor_map, relative_map):
        made = make(depth, np.random.default_rng(0))
        assert made.dtype == np.uint16
        assert (made[:, : made.shape[1] // 5] == 0).all()


def test_views_of_the_room_look_around() -> None:
    _, found = of_room(2, 1, 0)
    assert [len(found[split]) for split in ("train", "test")] == [2, 1]
    first, second = (camera for camera, _ in found["train"])
    assert first.forward @ second.forward < 0
