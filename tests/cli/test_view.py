"""``gs2d view RUN``: what is served, and how it ends."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cli_runs import one_line
from gs2d.cli import run
from gs2d.pipeline.options import ViewOptions
from gs2d.pipeline.view import open_viewer
from tiny import write_ball_mesh

pytest.importorskip("viser", reason="viser is not installed (extra `view`)")


def test_a_run_is_served_with_its_mesh_and_its_cameras(trained: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(trained, copy)
    write_ball_mesh(copy / "mesh.ply")
    viewer = open_viewer(copy, ViewOptions(threads=1))
    try:
        assert {kind: len(nodes) for kind, nodes in viewer.nodes.items()} == {"splats": 1, "mesh": 1, "cameras": 3}
    finally:
        viewer.close()


def test_a_run_without_its_capture_is_shown_without_cameras(trained: Path, tmp_path: Path) -> None:
    copy, notes = tmp_path / "run", []
    shutil.copytree(trained, copy)
    definition = json.loads((copy / "run.json").read_text())
    definition["scene"]["path"] = str(tmp_path / "gone")
    (copy / "run.json").write_text(json.dumps(definition))
    viewer = open_viewer(copy, ViewOptions(threads=1), notes.append)
    viewer.close()
    assert "cameras" not in viewer.nodes
    assert any("without cameras: the capture of" in getattr(note, "text", "") for note in notes)


def test_it_serves_until_ctrl_c_and_ends_with_130(trained: Path) -> None:
    words = [sys.executable, "-m", "gs2d", "view", str(trained), "--json", "--threads", "1"]
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
