"""The viewer: its numbers, its thread, its server; what a browser shows is in `test_server_in_a_browser.py`."""

from __future__ import annotations

import json
import socket
import struct
import sys
import threading
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.core.sh import rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.errors import BackendError, DataError
from gs2d.io.formats.registry import LAYOUTS, write_layout
from gs2d.io.meshes import glb_bytes, glb_turn, write_textured
from gs2d.pipeline.options import ViewOptions
from gs2d.pipeline.view import open_viewer
from gs2d.viewer.exact import Drawn, ExactImages, ViewerFrame, camera_of
from gs2d.viewer.server import free_port, quaternion, thumbnail
from gs2d.viewer.splats import preview

WORLD = ViewerFrame(np.zeros(3), 1.0)


def splats_at(means: list[list[float]], sizes: list[list[float]], quats: list[list[float]] | None = None) -> Splats:
    """Red, half opaque splats."""
    n = len(means)
    return Splats(
        means=torch.tensor(means),
        quats=torch.tensor(quats or [[1.0, 0, 0, 0]] * n),
        log_scales=torch.tensor(sizes).log(),
        opacity_logits=torch.zeros(n),
        sh0=rgb_to_sh0(torch.tensor([[0.75, 0.25, 0.25]]).expand(n, 3)).contiguous(),
        shN=torch.zeros(n, 3, 3),
    )


def eye(position: tuple[float, float, float]) -> Camera:
    return look_at(np.array(position), np.zeros(3), np.array([0, 0, 1.0]), width=30, height=20, fx=25.0)


def test_the_covariance_of_a_disc_is_that_of_its_axes_in_units_of_a_typical_splat() -> None:
    # median of the scales 1, 2, 2, 2: 2 world units is 1. A quarter turn about x takes the disc's y axis to z.
    turn = [2**-0.5, 2**-0.5, 0.0, 0.0]
    found = preview(splats_at([[0, 0, 4], [2, 0, 0]], [[1.0, 2.0], [2.0, 2.0]], [[1.0, 0, 0, 0], turn]))
    assert found.scale == pytest.approx(2)
    np.testing.assert_allclose(found.centers * found.scale, [[0, 0, 4], [2, 0, 0]])
    np.testing.assert_allclose(found.covariances[0], np.diag([0.25, 1, 0]), atol=1e-6)
    np.testing.assert_allclose(found.covariances[1], np.diag([1, 0, 1]), atol=1e-6)
    np.testing.assert_allclose(found.opacities, [[0.5], [0.5]])
    np.testing.assert_allclose(found.colors, [[0.75, 0.25, 0.25]] * 2, atol=1e-6)


def test_a_preview_has_the_mean_colour_that_the_cameras_see() -> None:
    splats = splats_at([[0.0, 0, 0]], [[1.0, 1.0]])
    splats.shN[0, 1] = 0.4  # times z of the direction and 0.4886: seen from above z = -1, from aside 0
    both = preview(splats, [eye((0, 1e-9, 3)), eye((3, 0, 0))]).colors[0]
    np.testing.assert_allclose(both, [0.75 - 0.4886 * 0.2, 0.25 - 0.4886 * 0.2, 0.25 - 0.4886 * 0.2], atol=1e-4)


def test_splats_that_are_not_finite_are_left_out_and_none_at_all_are_no_error() -> None:
    splats = splats_at([[0.0, 0, 0], [1, 1, 1]], [[1.0, 1.0], [1.0, 1.0]])
    splats.quats[0, 2] = float("nan")
    assert len(preview(splats).centers) == 1
    splats.means[1, 0] = float("inf")
    assert preview(splats).covariances.shape == (0, 3, 3)


def test_covariances_stay_within_the_16_bits_in_which_they_are_sent() -> None:
    found = preview(splats_at([[0.0, 0, 0]] * 3, [[1e-6, 1e-6], [1e-6, 1e-6], [1.0, 1.0]]))
    assert np.isfinite(found.covariances.astype(np.float16)).all()
    np.testing.assert_allclose(found.covariances[0].astype(np.float16), np.diag([1, 1, 0]))


def test_the_camera_of_a_browser_is_ours() -> None:
    camera = look_at(np.array([3.0, 1, 2]), np.array([0.5, 0, 0]), np.array([0, 0, 1.0]), width=300, height=200, fx=250)
    frame = ViewerFrame(np.array([1.0, 0, -1]), 4.0)
    view = SimpleNamespace(
        wxyz=quaternion(camera.rotation.T),
        position=frame.inside(camera.center),
        fov=2 * np.arctan(100 / 250),
        image_width=300,
        image_height=200,
    )
    same = camera_of(view, frame, 10**6)
    np.testing.assert_allclose(same.T_cam_world, camera.T_cam_world, atol=1e-12)
    assert (same.width, same.height) == (300, 200)
    assert (same.fx, same.fy, same.cx, same.cy) == pytest.approx((250, 250, 150, 100))
    small = camera_of(view, frame, 15_000)  # a quarter of the pixels
    assert (small.width, small.height) == (150, 100)
    assert small.fx == pytest.approx(125)
    np.testing.assert_allclose(frame.outside(view.position), camera.center)


class FakeServer:
    """The parts of viser's server that exact pictures use."""

    def __init__(self) -> None:
        self.clients: dict[int, Any] = {}
        self.connected: list[Callable[[Any], None]] = []
        self.images: list[tuple[int, tuple[int, ...], float]] = []  # client, size, largest depth

    def on_client_connect(self, call: Callable[[Any], None]) -> None:
        self.connected.append(call)

    def on_client_disconnect(self, call: Callable[[Any], None]) -> None:
        self.gone = call

    def get_clients(self) -> dict[int, Any]:
        return self.clients

    def connect(self, number: int) -> Any:
        calls: list[Callable[[Any], None]] = []
        camera = SimpleNamespace(
            wxyz=(1.0, 0, 0, 0),
            position=(0.0, 0, 0),
            fov=1.0,
            image_width=800,
            image_height=600,
            on_update=calls.append,
        )

        def draw(image: np.ndarray | None, *, depth: np.ndarray | None = None, **_: Any) -> None:
            size = () if image is None else image.shape[:2]
            self.images.append((number, size, 0.0 if depth is None else float(depth.max())))

        client = SimpleNamespace(client_id=number, camera=camera, moved=lambda: [call(camera) for call in calls])
        client.scene = SimpleNamespace(set_background_image=draw)
        self.clients[number] = client
        for call in self.connected:
            call(client)
        return client


def wait_for(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def flat(camera: Camera, _kind: str) -> Drawn:
    size = (camera.height, camera.width)
    return Drawn(np.zeros((*size, 3), np.uint8), np.full(size, np.inf, np.float32))


def test_exact_pictures_are_coarse_while_a_browser_moves_and_sharp_when_it_is_still() -> None:
    server = FakeServer()
    exact = ExactImages(server, WORLD, lambda: flat)
    client = server.connect(7)
    time.sleep(0.05)
    assert server.images == []  # nobody asked for them
    exact.draw("exact")
    wait_for(lambda: len(server.images) == 2)
    client.moved()
    wait_for(lambda: len(server.images) == 4)
    time.sleep(0.1)
    assert [size for _, size, _ in server.images] == [(240, 320), (600, 800)] * 2
    assert {depth for _, _, depth in server.images} == {160.0}  # as far as viser's depths reach
    exact.draw(None)
    assert server.images[4:] == [(7, (), 0.0)]  # taken away
    exact.close()
    assert exact.failure is None


def test_a_picture_that_cannot_be_drawn_is_not_silent() -> None:
    def fail(_camera: Camera, _kind: str) -> Drawn:
        raise ValueError("no such picture")

    server = FakeServer()
    exact = ExactImages(server, WORLD, lambda: fail)
    server.connect(1)
    exact.draw("depth")
    wait_for(lambda: exact.failure is not None)
    assert str(exact.failure) == "no such picture"
    exact.close()


def test_a_browser_that_is_closed_while_it_is_drawn_for_stops_nobody() -> None:
    server, drawn = FakeServer(), []

    def leave(camera: Camera, _kind: str) -> Drawn:
        drawn.append(camera.width)
        if len(drawn) == 1:
            server.gone(server.clients.pop(1))
            raise ConnectionError("nobody there")
        return flat(camera, _kind)

    exact = ExactImages(server, WORLD, lambda: leave)
    server.connect(1)
    exact.draw("exact")
    wait_for(lambda: len(drawn) == 1)
    server.connect(2)
    wait_for(lambda: len(server.images) == 2)
    assert {number for number, _, _ in server.images} == {2}
    assert exact.failure is None
    exact.close()


def test_a_port_that_is_taken_is_refused_if_it_was_asked_for_and_passed_by_if_not() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(BackendError, match=rf"a free port on 127\.0\.0\.1 was expected, port {port}: .*--port"):
            free_port("127.0.0.1", port)
        assert free_port("127.0.0.1", None) != port
    with pytest.raises(BackendError, match="--port must be 1 to 65535, got 0"):
        free_port("127.0.0.1", 0)
    with pytest.raises(BackendError, match="a free port on no such host was expected"):
        free_port("no such host", 8080)


def test_thumbnails_are_small_and_lie_over_the_background() -> None:
    image = np.zeros((400, 800, 4), np.uint8)
    image[:, :400] = (10, 200, 30, 255)
    small = thumbnail(image, (1.0, 0.0, 1.0))
    assert small.shape == (80, 160, 3)
    assert small[40, 20].tolist() == [10, 200, 30]
    assert small[40, 140].tolist() == [255, 0, 255]


def test_a_coloured_mesh_becomes_a_glb_with_its_colours(tmp_path: Path) -> None:
    colors = np.array([[255, 0, 0], [0, 188, 0], [12, 0, 255]], np.uint8)
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), colors)
    (tmp_path / "a.glb").write_bytes(glb_bytes(mesh))
    loaded = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    np.testing.assert_allclose(loaded.vertices, np.eye(3))
    # linear in the file (glTF 3.7.2.1): ((188 / 255 + 0.055) / 1.055)^2.4 = 0.5029, 12 / 255 / 12.92 about 0.0037
    data = glb_bytes(mesh)
    length = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + length])
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    start = 28 + length + document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    found = np.frombuffer(data, "<u2", 12, start).reshape(3, 4) / 65535
    np.testing.assert_allclose(found, [[1, 0, 0, 1], [0, 0.5029, 0, 1], [0.00364, 0, 1, 1]], atol=1e-4)
    assert glb_turn(glb_bytes(mesh)) == [0, 0, 0, 1]
    with pytest.raises(DataError, match=r"\.glb file as `gs2d mesh --texture` writes it"):
        glb_turn(b"something else of some length, not a mesh")


def test_a_missing_package_is_one_line_with_the_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(BackendError, match=r"the viewer needs viser, .*pip install 'viser>="):
        open_viewer(tmp_path)


@pytest.mark.parametrize("layout", ["2dgs", "spz"])
def test_a_file_of_splats_is_served_on_this_machine_until_the_viewer_is_closed(tmp_path: Path, layout: str) -> None:
    pytest.importorskip("viser", reason="viser is not installed (extra `view`)")
    path = tmp_path / f"a{LAYOUTS.get(layout).ending}"
    write_layout(path, splats_at([[0.0, 0, 0], [1, 0, 0]], [[0.1, 0.2], [0.3, 0.1]]), layout)
    threads = set(threading.enumerate())
    viewer = open_viewer(path, ViewOptions(threads=1))
    try:
        assert set(viewer.nodes) == {"splats"}
        assert viewer.url == f"http://127.0.0.1:{viewer.port}/?token={viewer.token}"
        with urllib.request.urlopen(viewer.url, timeout=20) as page:
            assert b"<!doctype html>" in page.read(100)
        with pytest.raises(BackendError, match="a free port"):
            free_port("127.0.0.1", viewer.port)
    finally:
        viewer.close()
    wait_for(lambda: free_port("127.0.0.1", viewer.port) == viewer.port)
    left = {thread for thread in set(threading.enumerate()) - threads if thread.is_alive() and not thread.daemon}
    assert not [thread.name for thread in left if thread.name == "gs2d view"]


def test_three_dimensional_gaussians_are_no_scene_to_look_at(shared: Callable[[str], Path]) -> None:
    pytest.importorskip("viser", reason="viser is not installed (extra `view`)")
    with pytest.raises(DataError, match="flat splats were expected, got 3D Gaussians with three scales"):
        open_viewer(shared("gaussians_plush_dog") / "point_cloud_29999_clean.compressed.ply")


def test_nothing_or_a_mesh_is_no_scene_to_look_at(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed (extra `view`)")
    with pytest.raises(DataError, match="expected a run folder or a file of splats"):
        open_viewer(tmp_path / "nothing.ply")
    mesh = TexturedMesh(np.eye(3), np.eye(3), np.array([[0, 1, 2]]), np.zeros((3, 2)), np.zeros((4, 4, 3), np.uint8))
    write_textured(tmp_path / "mesh.glb", mesh)
    with pytest.raises(DataError):
        open_viewer(tmp_path / "mesh.glb")
