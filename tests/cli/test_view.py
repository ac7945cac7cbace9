"""``gs2d view RUN``: what is served, and how it ends."""

from __future__ import annotations

import io
import json
import shutil
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from cli_runs import one_line
from gs2d.cli import run
from gs2d.core.camera import look_at
from gs2d.core.mesh import TexturedMesh
from gs2d.core.splats import Splats
from gs2d.data import View
from gs2d.errors import DataError
from gs2d.io.formats.registry import LAYOUTS, write_layout
from gs2d.io.meshes import glb_bytes, read_mesh, write_textured
from gs2d.pipeline.look.view import images_route, open_viewer, serve
from gs2d.viewer.server import PageServer
from tiny import write_ball_mesh


def fetch(server: PageServer, path: str, **values: str) -> tuple[Any, bytes]:
    """Headers and body of an answer."""
    more = "".join(f"&{name}={value}" for name, value in values.items())
    with urllib.request.urlopen(server.url.replace("/?", f"/{path}?") + more, timeout=20) as answer:
        return answer.headers, answer.read()


def facts_of(page: bytes) -> dict[str, Any]:
    return dict(json.loads(page.decode().split('id="facts">')[1].split("</script>")[0]))


def test_a_run_is_served_with_its_stages_its_mesh_and_its_cameras(trained: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    write_ball_mesh(copy / "mesh.ply")
    server, shown = open_viewer(copy)
    try:
        assert shown == ["cameras", "mesh", "splats"]
        facts = facts_of(fetch(server, "")[1])
        stages = facts["served"]["stages"]
        assert facts["served"] == {"stages": stages, "has_mesh": True, "has_images": True, "is_live": False}
        assert stages == ["surface", "appearance", "final"]
        for stage in stages:
            headers, data = fetch(server, "splats", stage=stage)
            told = json.loads(headers["X-Splats"])
            assert len(data) == (32 + 16 * told["stored"]) * told["splats"] > 0
        assert fetch(server, "mesh")[1] == glb_bytes(read_mesh(copy / "mesh.ply"))
        assert len(facts["cameras"]) == 3
        with Image.open(io.BytesIO(fetch(server, "image", view="2")[1])) as image:
            assert image.size == (20, 20)
        for path, values in (("splats", {"stage": "other"}), ("image", {"view": "3"})):
            with pytest.raises(urllib.error.HTTPError, match="400"):
                fetch(server, path, **values)
        assert server.failure is None
        write_textured(copy / "mesh.glb", TexturedMesh(np.eye(3), np.eye(3), np.array([[0, 1, 2]]),
                                                       np.zeros((3, 2)), np.zeros((4, 4, 3), np.uint8)))  # fmt: skip
    finally:
        server.close()
    server, _ = open_viewer(copy)
    assert fetch(server, "mesh")[1] == (copy / "mesh.glb").read_bytes()
    server.close()


def test_images_are_small_and_lie_over_the_background() -> None:
    image = np.zeros((800, 1600, 4), np.uint8)
    image[:, :800] = (10, 200, 30, 255)
    camera = look_at(np.array([3.0, 0, 0]), np.zeros(3), np.array([0, 0, 1.0]), width=1600, height=800, fx=800)
    answer = images_route([View.from_arrays("a", camera, image)], (1.0, 0.0, 1.0))({"view": "0"})
    assert answer.kind == "image/jpeg"
    with Image.open(io.BytesIO(answer.parts[0])) as small:
        assert small.size == (640, 320)
        np.testing.assert_allclose(small.getpixel((100, 100)), (10, 200, 30), atol=8)  # type: ignore[arg-type]
        np.testing.assert_allclose(small.getpixel((500, 100)), (255, 0, 255), atol=8)  # type: ignore[arg-type]


def test_a_run_without_its_capture_is_shown_without_cameras(trained: Path, tmp_path: Path) -> None:
    copy, notes = tmp_path / "run", []
    shutil.copytree(trained, copy)
    definition = json.loads((copy / "run.json").read_text())
    definition["scene"]["path"] = str(tmp_path / "gone")
    (copy / "run.json").write_text(json.dumps(definition))
    server, shown = open_viewer(copy, None, notes.append)
    server.close()
    assert "cameras" not in shown
    assert any("without the cameras of the photographs" in getattr(note, "text", "") for note in notes)


@pytest.mark.parametrize("layout", ["2dgs", "spz"])
def test_a_file_of_splats_is_served(tmp_path: Path, layout: str) -> None:
    rows = torch.Generator().manual_seed(0)
    splats = Splats(*(torch.randn(5, *size, generator=rows) for size in ((3,), (4,), (2,), (), (1, 3), (15, 3))))
    path = tmp_path / f"a{LAYOUTS.get(layout).ending}"
    write_layout(path, splats, layout)
    server, shown = open_viewer(path)
    try:
        assert shown == ["splats"]
        assert json.loads(fetch(server, "splats", stage="final")[0]["X-Splats"])["splats"] == 5
    finally:
        server.close()


def test_three_dimensional_gaussians_are_refused(shared: Callable[[str], Path]) -> None:
    with pytest.raises(DataError, match="flat splats were expected, got 3D Gaussians with three scales"):
        open_viewer(shared("gaussians_plush_dog") / "point_cloud_29999_clean.compressed.ply")


def test_nothing_or_a_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a run folder or a file of splats"):
        open_viewer(tmp_path / "nothing.ply")
    mesh = TexturedMesh(np.eye(3), np.eye(3), np.array([[0, 1, 2]]), np.zeros((3, 2)), np.zeros((4, 4, 3), np.uint8))
    write_textured(tmp_path / "mesh.glb", mesh)
    with pytest.raises(DataError):
        open_viewer(tmp_path / "mesh.glb")


def test_a_defect_ends_the_command() -> None:
    server = PageServer(None, {})
    server.failure = ValueError("a defect")
    with pytest.raises(ValueError, match="a defect"):
        serve(server)
    server.close()


def test_it_serves_until_ctrl_c_and_ends_with_130(trained: Path) -> None:
    words = [sys.executable, "-m", "gs2d", "view", str(trained), "--json"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if line == "}\n":
                break
        assert json.loads("".join(lines))["url"].startswith("http://127.0.0.1:")
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert out == ""
    assert err.splitlines()[-1] == "interrupted"
    assert "Traceback" not in err


def test_a_senseless_port_is_one_line(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["view", str(trained), "--port", "99999", "--quiet"]) == 2
    assert "--port must be 1 to 65535, got 99999" in one_line(capsys.readouterr().err)
