"""``gs2d view RUN``: what is served, and how it ends."""

from __future__ import annotations

import io
import json
import shutil
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gs2d.core.mesh import TexturedMesh
from gs2d.errors import DataError
from gs2d.io.meshes import read_mesh, read_textured, write_mesh
from gs2d.meshing.web_mesh import web_mesh
from gs2d.pipeline.look.view import open_viewer, serve
from gs2d.viewer.page_server import PageServer
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
        stages = facts["offer"]["stages"]
        assert facts["offer"] == {
            "meshes": ["mesh"],
            "photographs": True,
            "served": True,
            "stages": stages,
            "live": False,
        }
        assert stages == ["surface", "appearance", "final"]
        for stage in stages:
            headers, data = fetch(server, "splats", stage=stage)
            packed = json.loads(headers["X-Splats"])
            assert len(data) == (32 + 16 * packed["texels"]) * packed["splats"] > 0
        assert fetch(server, "mesh")[1] == web_mesh(read_mesh(copy / "mesh.ply"))
        assert len(facts["cameras"]) == 3
        with Image.open(io.BytesIO(fetch(server, "photograph", view="2")[1])) as image:
            assert image.size == (20, 20)
        for path, values in (("splats", {"stage": "other"}), ("photograph", {"view": "3"})):
            with pytest.raises(urllib.error.HTTPError, match="400"):
                fetch(server, path, **values)
        assert server.failure is None
        write_mesh(copy / "mesh.glb", TexturedMesh(np.eye(3), np.eye(3), np.array([[0, 1, 2]]),
                                                       np.zeros((3, 2)), np.zeros((4, 4, 3), np.uint8)))  # fmt: skip
    finally:
        server.close()
    server, _ = open_viewer(copy)
    assert fetch(server, "textured")[1] == web_mesh(read_textured(copy / "mesh.glb"))
    server.close()


def test_nothing_or_a_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="folder"):
        open_viewer(tmp_path / "nothing.ply")
    mesh = TexturedMesh(np.eye(3), np.eye(3), np.array([[0, 1, 2]]), np.zeros((3, 2)), np.zeros((4, 4, 3), np.uint8))
    write_mesh(tmp_path / "mesh.glb", mesh)
    with pytest.raises(DataError):
        open_viewer(tmp_path / "mesh.glb")


def test_an_error_in_the_server_ends_the_command() -> None:
    server = PageServer(None, {})
    server.failure = ValueError("a defect")
    with pytest.raises(ValueError, match="a defect"):
        serve(server)
    server.close()


def test_view_serves_until_ctrl_c_and_exits_with_130(trained: Path) -> None:
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
        out, err = process.communicate(timeout=600)
    assert process.returncode == 130
    assert out == ""
    assert err.splitlines()[-1] == "interrupted"
    assert "Traceback" not in err
