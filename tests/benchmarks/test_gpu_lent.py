"""The minutes of a GPU that is lent: which Python is taken, what comes home, what is measured first."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from benchmarks.gpu import __main__ as command
from benchmarks.gpu import archive, capture, first, scenes, training
from benchmarks.gpu.bench import Bench

from gs2d.data import load_scene
from gs2d.kernels.cuda.compile import compile_text
from gs2d.pipeline.events import StageDone

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "benchmarks" / "gpu" / "lent.sh"
BIN = Path(sys.executable).parent
pytestmark = pytest.mark.timeout(280)

TALKS = """
import sys, warnings
warnings.warn("The pynvml package is deprecated", FutureWarning)
print("something about a library", file=sys.stderr)
class version: cuda = "13.0"
__version__ = "2.99"
"""


def lent(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """The script, in another folder than the checkout."""
    settings = {**os.environ, "PATH": f"{BIN}:{os.environ['PATH']}", **environment}
    call = ["bash", str(SCRIPT), *arguments]
    return subprocess.run(call, env=settings, cwd="/", capture_output=True, text=True, timeout=200, check=False)


def test_a_torch_that_talks_while_it_loads_is_taken(tmp_path: Path) -> None:
    """Wherever pynvml is installed, `import torch` warns: that was read as a reason, and no Python fitted."""
    (tmp_path / "torch.py").write_text(TALKS)
    done = lent("0", str(tmp_path / "out"), PYTHONPATH=str(tmp_path), MINUTES="0")
    assert "no Python fits" not in done.stderr


def test_the_clock_runs_from_the_first_line() -> None:
    """Two cold imports of torch take a minute of ten."""
    lines = [line for line in SCRIPT.read_text().splitlines() if line and not line.startswith("#")]
    assert lines[0] == "begun=$(date +%s)"
    assert all("timeout" in line for line in lines if '"$python" -W ignore' in line or '"$1" -W ignore' in line)


def run_folder(folder: Path) -> Path:
    """As `gs2d train` leaves one: 85 files, 60 of them deep, the report and the figures among them."""
    for k in range(60):
        path = folder / "runs" / "run-lego" / "renders" / "surface" / f"{k}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(os.urandom(3000))
    for name in ("metrics.json", "report.html", "splats.ply"):
        (folder / "runs" / "run-lego" / name).write_text(name * 100)
    (folder / "log.txt").write_text("said")
    (folder / "trace-1M.json.gz").write_bytes(os.urandom(50_000))
    (folder / ".site" / "package").mkdir(parents=True)
    (folder / ".site" / "package" / "x.json").write_text("{}")
    return folder


def test_one_archive_holds_what_is_worth_bringing_home(tmp_path: Path) -> None:
    folder, home = run_folder(tmp_path / "work"), tmp_path / "out" / "part_2.tar.gz"
    home.parent.mkdir()
    assert archive.pack(folder, home) == []
    with tarfile.open(home) as tar:
        names = tar.getnames()
    assert set(names) == {
        "log.txt", "trace-1M.json.gz", "runs/run-lego/metrics.json", "runs/run-lego/report.html"
    }  # fmt: skip
    assert [path.name for path in home.parent.iterdir()] == ["part_2.tar.gz"]


def test_what_has_no_room_is_named_and_the_figures_come_first(tmp_path: Path) -> None:
    folder, home = run_folder(tmp_path / "work"), tmp_path / "part_2.tar.gz"
    (left_out,) = archive.pack(folder, home, limit_bytes=20_000)
    assert left_out == "trace-1M.json.gz (50000 bytes)"
    assert home.stat().st_size <= 20_000
    with tarfile.open(home) as tar:
        assert tar.getnames()[0] == "runs/run-lego/metrics.json"
        said = tar.extractfile(archive.LEFT_OUT)
        assert said is not None
        assert said.read().decode().strip() == left_out


@pytest.mark.slow
@pytest.mark.parametrize("part", ["0", "1", "2", "3"])
def test_a_dry_run_of_each_part_leaves_two_files_and_no_folder(part: str, tmp_path: Path) -> None:
    """Eight files, none more than two folders down, come home from a machine that is lent."""
    done = lent(part, str(tmp_path), DRY="--dry-run", GS2D_COMMIT="abc", MINUTES="2" if part == "2" else "0")
    assert done.returncode == 0, done.stderr
    found = sorted(tmp_path.rglob("*"))
    assert all(path.is_file() and path.parent == tmp_path for path in found)
    (document,) = [json.loads(path.read_text()) for path in found if path.suffix == ".json"]
    assert document["commit"] == "abc"
    with tarfile.open(tmp_path / f"part_{part}.tar.gz") as tar:
        names = tar.getnames()
    assert "log.txt" in names
    if part == "2":
        assert {Path(name).name for name in names} >= {"metrics.json", "report.html"}
    assert len(found) == 2


@pytest.mark.slow
def test_part_0_goes_the_whole_way(tmp_path: Path) -> None:
    out = tmp_path / "first.json"
    assert command.main(["first", "--dry-run", "--out", str(out)]) == 0
    results = json.loads(out.read_text())["results"]
    assert list(results) == ["machine", "exercise", "parity", "host", "60-32x16-A"]
    assert results["exercise"]["clean"]
    assert results["60-32x16-A"]["surface"]["iteration_ms"] > 0


def test_part_0_says_what_the_machine_lacks_without_a_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))  # no nvidia-smi
    found = first.machine()
    if torch.version.cuda is None:
        assert found["missing"].startswith(f"torch {torch.__version__} is built without CUDA; ")
    assert "nvidia-smi" in found["nvidia_smi"]
    assert json.dumps(found)


def test_the_share_of_the_time_in_which_the_gpu_works() -> None:
    assert first.busy_fraction([]) is None
    assert first.busy_fraction([(0.0, 2.0), (1.0, 3.0), (6.0, 10.0)]) == 0.7
    assert first.busy_fraction([(5.0, 6.0), (0.0, 10.0)]) == 1.0


def test_the_goals_have_their_inputs_and_the_largest_of_the_usual_scenes_comes_first() -> None:
    assert (300_000, 800, 800) in scenes.SIZES  # 60k iterations of an object in 75 s
    assert scenes.SIZES[0] == (1_000_000, 1600, 1060)
    assert set(scenes.FIRST) == {(300_000, 800, 800), (1_000_000, 1600, 1060)}


def test_a_capture_is_made_where_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def gray(_launcher: Any, _splats: Any, camera: Any, _settings: Any) -> Any:
        return SimpleNamespace(color=torch.full((camera.height, camera.width, 3), 0.5))

    monkeypatch.setattr(capture.cuda, "rasterize_with", gray)
    folder = capture.write_capture(Bench(None, None, True), tmp_path / "made")  # type: ignore[arg-type]
    scene = load_scene(folder)
    _, side, train, test = capture.TOY
    assert (len(scene.train), len(scene.test)) == (train, test)
    for view, camera in zip(scene.train, capture.poses(train, side, 0.0), strict=True):
        assert np.allclose(view.camera.T_cam_world, camera.T_cam_world, atol=1e-6)
        assert view.camera.fx == pytest.approx(camera.fx)
        assert (view.image()[..., :3] == 128).all()
        assert camera.center[1] < 0.8 - capture.NEVER_BELOW  # y is down, the floor at 0.8
    assert capture.TEACHER == 300_000
    assert (capture.SIDE, capture.TRAIN) == (800, 100)


def test_each_stage_is_in_the_file_when_it_ends_also_of_a_run_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(options: Any, on_event: Any) -> Any:
        on_event(StageDone({"name": "surface", "seconds": 61.5, "iterations": 30_000, "other": 1}))
        raise RuntimeError("CUDA error: the launch timed out")

    monkeypatch.setattr(training, "train", fails)
    monkeypatch.setattr(training, "toy_capture", lambda folder: tmp_path / "ball")
    seen: list[str] = []
    bench = Bench(None, None, True)  # type: ignore[arg-type]
    found = training.run(bench, [], 1.0, 1, None, lambda partial: seen.append(json.dumps(partial)))
    assert json.loads(seen[0])["ball"]["stages_so_far"][0]["seconds"] == 61.5
    assert found["ball"]["failed"].startswith("RuntimeError: CUDA error")
    assert found["ball"]["stages_so_far"][0]["iterations"] == 30_000
    assert len(training.table(found)) == 1


def test_the_probe_of_multiply_adds_issues_hardly_anything_else() -> None:
    """Seven instructions to count rounds for every 64 made each kernel look 9 % better than it is."""
    pytest.importorskip("cuda.bindings", reason="cuda-bindings is not here")
    from benchmarks.gpu.sass import listing

    code = compile_text((ROOT / "benchmarks" / "gpu" / "probes.cu").read_text(), "probes.cu", "sm_90").code
    loops = listing(code)["probe_fma"].loops()
    most = max(loops, key=len)
    share = sum(line.startswith("FFMA") for line in most) / len(most)
    assert share > 0.96, share
