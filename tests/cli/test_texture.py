"""``gs2d mesh RUN --texture``: files, messages and errors."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cli_runs import one_line
from gs2d.cli import run
from tiny import RADIUS, write_ball_mesh

pytest.importorskip("xatlas", reason="xatlas is not installed (extra `texture`)")


@pytest.fixture
def ball(trained: Path, tmp_path: Path) -> Path:
    """The run, with the true ball as its mesh."""
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    write_ball_mesh(folder / "mesh.ply")
    return folder


def test_the_mesh_of_a_run_gets_a_texture_from_the_photographs(ball: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (ball / "mesh.ply").read_bytes()
    assert run(["mesh", str(ball), "--texture", "--threads", "1"]) == 0
    out, _ = capsys.readouterr()
    assert "mesh.glb: 2,304 triangles" in out
    assert "not visible in any photograph" in out
    assert (ball / "mesh.ply").read_bytes() == before
    assert 'href="mesh.glb"' in (ball / "report.html").read_text()
    scene = trimesh.load(ball / "mesh.glb")
    mesh = next(iter(scene.geometry.values()))
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), RADIUS, rtol=1e-5)  # in the capture's frame
    visible = mesh.vertices[:, 2] > 0.1  # red, green and blue follow x, y, z; the cameras are above
    colors = np.asarray(mesh.visual.to_color().vertex_colors)[:, :3] / 255
    expected = 0.5 + 0.4 * mesh.vertices / RADIUS + 0.1 * np.sin(9 * mesh.vertices)
    assert np.median(np.abs(colors - expected)[visible]) < 0.03  # photographs of 20 x 20


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--set", "faces=100"], "--texture"),
        (["--set", "texture_size=64"], "needs --texture"),
        (["--texture", "--set", "faces=2"], "number"),
        (["--texture", "--set", "texture_size=10"], "texels"),
        (["--texture", "--set", "texture_downscale=0"], "number"),
        (["--texture", "--out", "mesh.ply"], "written"),
        (["--texture", "--out", "no/such/folder/a.glb"], "existing folder"),
    ],
)
def test_a_run_that_cannot_be_textured_is_a_one_line_error(
    trained: Path, words: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["mesh", str(trained), *words]) == 2
    assert named in one_line(capsys.readouterr().err)


def test_no_photograph_is_written_over(ball: Path, capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["mesh", str(ball), "--texture", "--out", str(capture / "train" / "r_0.obj")]) == 2
    assert "photograph" in one_line(capsys.readouterr().err.splitlines()[-1])


def test_without_the_extra_the_remedy_is_named(
    trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "xatlas", None)  # import raises ModuleNotFoundError
    assert run(["mesh", str(trained), "--texture"]) == 2
    assert "pip install 'xatlas>=" in one_line(capsys.readouterr().err)
