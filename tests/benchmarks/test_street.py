"""The table of real photographs: what is run and watched, what is read from it, and what is said of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import street, street_gallery, street_runs
from benchmarks.street_runs import Process, estimate_error, reconstruct_command, told_estimate, typed, watch_process
from PIL import Image

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.data.image_files import write_image
from gs2d.evaluation.images import ImageMetrics, Metric
from gs2d.io.meshes import write_mesh
from gs2d.pipeline.estimate import Estimate, Range


def process(command: list[str], exit_code: int = 0) -> Process:
    return Process(command, exit_code, 120.0, 90.0, 30.0, 10**9)


def metrics(psnr: float, ssim: float) -> ImageMetrics:
    none = Metric(None, "not measured")
    return ImageMetrics(Metric(psnr), Metric(ssim), none, none, none, none)


# -- a process -----------------------------------------------------------------------------------------------------
def test_a_process_is_watched_with_its_children_and_what_it_took_before_a_file_was_there(tmp_path: Path) -> None:
    burn = "import time; start = time.process_time()\nwhile time.process_time() < start + 0.4: pass\n"
    child = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {burn!r}], check=True)\n"
    made = tmp_path / "cameras"
    code = child + f"open({str(made)!r}, 'w')\nimport time; time.sleep(1.0)\n{burn}x = bytearray(60 << 20); sys.exit(3)"
    took = watch_process([sys.executable, "-c", code], tmp_path / "console.txt", when=made)
    assert took.exit_code == 3
    assert took.cpu_seconds >= 0.8
    assert took.cpu_seconds_before is not None
    assert 0.4 <= took.cpu_seconds_before <= took.cpu_seconds - 0.35
    assert took.seconds >= 1.0
    assert took.peak_rss_bytes > 60 << 20


def test_what_a_process_says_is_kept_and_a_signal_is_a_negative_code(tmp_path: Path) -> None:
    words = "print('told', flush=True); print('wrong', file=sys.stderr, flush=True)"
    code = f"import os, sys; {words}; os.kill(os.getpid(), 9)"
    took = watch_process([sys.executable, "-c", code], tmp_path / "console.txt", when=tmp_path / "never")
    assert took.exit_code == -9
    assert took.cpu_seconds_before is None
    assert (tmp_path / "console.txt").read_text().split() == ["told", "wrong"]


# -- a capture -----------------------------------------------------------------------------------------------------
def test_test_views_are_asked_for_only_where_reconstruct_would_hold_none_out() -> None:
    few = reconstruct_command(Path("p"), 23, Path("r"), "draft")
    assert few == ["reconstruct", "p", "--out", "r", "--quality", "draft", "--test-every", "8"]
    assert "--test-every" not in reconstruct_command(Path("p"), 24, Path("r"), "draft")
    own = reconstruct_command(Path("p"), 11, Path("r"), "draft", ["--test-every", "4"])
    assert own.count("--test-every") == 1


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Commands that were started; each leaves a file in the run folder."""
    commands: list[list[str]] = []

    def watch(command: list[str], console: Path, **_: Any) -> Process:
        commands.append(list(command))
        run = Path(command[command.index("--out") + 1])
        assert not run.exists(), "a run that was cut off is begun anew"
        run.mkdir()
        console.write_text("")
        return process(list(command))

    monkeypatch.setattr(street_runs, "watch_process", watch)
    return commands


def test_photographs_alone_are_used_and_a_finished_run_is_not_repeated(
    tmp_path: Path, started: list[list[str]]
) -> None:
    source, folder = tmp_path / "data", tmp_path / "draft" / "shed"
    folder.mkdir(parents=True)
    source.mkdir()
    for k in range(3):
        Image.new("RGB", (8, 6), (k, 0, 0)).save(source / f"{k}.png")
    (source / "transforms.json").write_text("{}")
    first = street_runs.run_reconstruct(source, folder, "draft")
    photos = folder / "photographs" / "shed"
    assert sorted(path.name for path in photos.iterdir()) == ["0.png", "1.png", "2.png"]
    assert street_runs.run_reconstruct(source, folder, "draft") == first
    assert len(started) == 1
    (folder / "process.json").unlink()  # as if it had been cut off
    street_runs.run_reconstruct(source, folder, "draft")
    street_runs.run_reconstruct(source, folder, "draft", ["--exposure"])  # another command is another run
    assert len(started) == 3
    assert started[0][1:3] == ["-m", "gs2d"]


def test_the_estimate_is_read_from_what_the_run_said_and_its_error_is_a_factor() -> None:
    line = "note training will take about 40 s to 2.5 min: 900 iterations, 30 ms each at the start"
    assert told_estimate(f"a line\n{line}\n") == {"line": line, "least": 40.0, "most": 150.0}
    assert told_estimate("training will take about 3 h") is not None
    assert told_estimate("nothing of the kind") is None
    told = {"least": 40.0, "most": 150.0}
    assert [estimate_error(told, seconds) for seconds in (20.0, 40.0, 100.0, 300.0)] == [2.0, 1.0, 1.0, 2.0]
    assert estimate_error(None, 3.0) is None


def test_the_estimate_that_gs2d_tells_today_is_understood() -> None:
    found = Estimate(
        photographs=6, pixels=1, trained_pixels=1, downscale=1, iterations=900, start=1, splats=Range(1, 2, 3),
        max_splats=None, memory=Range(1, 2, 3), allowed=None, prepared=False, disk=1, temporary=1,
        training=Range(80.0, 160.0, 360.0), seconds=Range(90.0, 180.0, 400.0),
    )  # fmt: skip
    told = told_estimate(found.line())
    assert told is not None
    assert (told["least"], told["most"]) == (80.0, 360.0)


def test_views_are_summed_up_by_their_mean_and_the_worst() -> None:
    summary = street_runs.summary_of({"a": metrics(20.0, 0.5), "b": metrics(12.0, 0.7)})
    assert summary is not None
    assert (summary["psnr"], summary["ssim"], summary["worst_psnr"]) == (16.0, 0.6, 12.0)
    assert summary["worst_view"] == "b"
    assert street_runs.summary_of({}) is None


def test_the_part_of_a_mesh_in_the_subjects_box_is_by_area() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [9, 0, 0], [5, 2, 0]], dtype=np.float32)
    mesh = Mesh(corners, np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32))  # areas 0.5 and 4
    box = np.array([[-1.0, -1, -1], [1, 1, 1]])
    assert street_runs.fraction_in_box(mesh, box) == pytest.approx(0.5 / 4.5)
    assert street_runs.fraction_in_box(Mesh(corners, np.zeros((0, 3), np.int32)), box) == 0.0


# -- the table -----------------------------------------------------------------------------------------------------
def row(capture: str, **changes: Any) -> dict[str, Any]:
    test = {"views": 2, "psnr": 21.0, "ssim": 0.7, "worst_psnr": 18.0, "worst_view": "b"}
    return {
        "capture": capture,
        "exit_code": 0,
        "poses": {"placed": 11, "photographs": 12},
        "seconds": 120.0,
        "cpu_seconds": 90.0,
        "cpu_seconds_before": 30.0,
        "estimate": {"least": 60.0, "most": 240.0},
        "training_seconds": 90.0,
        "scores": {"test": test, "train": test | {"psnr": 25.0}, "hidden": {"share": 0.0125}},
        "mesh": {"faces": 12345},
        "peak_rss_bytes": 1.5e9,
        **changes,
    }


def test_a_run_without_results_is_a_row_of_dashes_and_the_peer_stands_beside_ours() -> None:
    peer = {"scores": {"test": {"psnr": 19.5, "ssim": 0.6, "worst_psnr": 15.25}}}
    failed = row("shed", exit_code=1, poses=None, scores=None, mesh=None, estimate=None, training_seconds=None)
    header, _, good, bad = street.markdown([row("fox", peer=peer), failed]).splitlines()
    cells = dict(zip(*(map(str.strip, line.strip("|").split("|")) for line in (header, good)), strict=True))
    assert cells["test PSNR / SSIM"] == "21.00 / 0.700"
    assert (cells["peer"], cells["peer's worst"]) == ("19.50 / 0.600", "15.25")
    assert (cells["placed"], cells["training: told, took"]) == ("11 of 12", "1.0 to 4.0, 1.5")
    assert (cells["hidden points"], cells["faces"], cells["in subject"]) == ("1.25%", "12,345", "-")
    assert bad.startswith("| shed | 1 | - | 2.0 |")


def test_rows_are_written_as_they_are_there_and_a_failed_run_shows_in_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results, out = tmp_path / "results.json", tmp_path / "out"
    for folder in ("fox_instant_ngp/images", "monstree/images"):
        (tmp_path / "data" / folder).mkdir(parents=True)

    def measured(source: Path, folder: Path, quality: str, extra: Any) -> dict[str, Any]:
        assert (quality, list(extra)) == ("normal", ["--exposure"])
        if folder.name == "monstree":  # the row of fox is safe by now
            assert [r["capture"] for r in json.loads(results.read_text())["rows"]] == ["fox"]
        return row(folder.name, exit_code=int(folder.name == "monstree"))

    monkeypatch.setattr(street, "measure_run", measured)
    words = ["--data", str(tmp_path / "data"), "--out", str(out), "--results", str(results), "--quality", "normal"]
    words += ["--options=--exposure"]
    assert street.main([*words, "--captures", "monstree", "fox"]) == 1
    assert [r["capture"] for r in json.loads(results.read_text())["rows"]] == ["fox", "monstree"]
    assert (out / "normal.md").read_text().count("\n| ") == 2
    with pytest.raises(SystemExit, match="2"):
        street.main([*words, "--captures", "bust"])  # its folder is not there


def test_the_budget_of_the_peer_is_what_was_taken_after_the_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "monstree/images").mkdir(parents=True)
    (tmp_path / "opensplat").touch()
    budgets: list[float] = []

    def peer(binary: Path, run: Path, folder: Path, budget: float) -> dict[str, Any]:
        budgets.append(budget)
        return {}

    monkeypatch.setattr(street, "measure_run", lambda *_: row("monstree"))
    monkeypatch.setattr(street, "measure_peer", peer)
    words = ["--data", str(tmp_path), "--out", str(tmp_path / "out"), "--captures", "monstree"]
    assert street.main([*words, "--opensplat", str(tmp_path / "opensplat")]) == 0
    assert budgets == [60.0]


# -- the gallery ---------------------------------------------------------------------------------------------------
def finished_run(run: Path) -> None:
    """A run of one view of a triangle, as far as pictures need it."""
    camera = Camera(20, 16, 18.0, 18.0, 10.0, 8.0, np.eye(4))
    shown = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    entry = {"file": "a", "camera": {**shown, "T_cam_world": np.eye(4).tolist()}}
    colors = {"photos/a.png": 250, "end/a.color.png": 150, "end/a.normal.png": 50}
    for name, value in colors.items():
        (run / "renders" / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(run / "renders" / name, np.full((16, 20, 3), value, dtype=np.uint8))
    (run / "renders" / "index.json").write_text(json.dumps({"views": [entry]}))
    (run / "metrics.json").write_text(json.dumps({"stages": [{"name": "end"}]}))
    corners = np.array([[-1.0, -1, 2], [1, -1, 2], [0, 1, 2]], dtype=np.float32)
    write_mesh(run / "mesh.ply", Mesh(corners, np.array([[0, 1, 2]], dtype=np.int32)))


def test_the_gallery_shows_four_pictures_a_capture_and_says_which_may_not_be_published(tmp_path: Path) -> None:
    finished_run(tmp_path / "runs" / "bottle" / "run")
    finished_run(tmp_path / "runs" / "bust" / "run")
    chosen = [capture for capture in street.CAPTURES if capture.name in ("bottle", "bust", "fox")]
    files = street_gallery.write_gallery(tmp_path / "gallery", chosen, tmp_path / "runs", "draft")
    assert [file.name for file in files] == ["bust-draft.jpg", "bottle-draft.jpg"]
    image = np.asarray(Image.open(files[0]).convert("L"), dtype=int)
    assert image.shape == (240, 4 * 300 + 3 * 4)
    middles = [image[120, 150 + 304 * k] for k in range(4)]
    assert np.abs(np.subtract(middles[:3], (250, 150, 50))).max() < 4
    assert image[5, -295] > 250  # beside the mesh
    assert middles[3] < 230
    page = (tmp_path / "gallery" / "gallery-draft.md").read_text()
    assert "no: CC BY-NC-SA" in page
    assert "yes: CC BY 4.0" in page
    assert "| fox | not finished" in page


def test_only_what_its_licence_allows_may_be_shown() -> None:
    allowed = [capture.name for capture in street.CAPTURES if capture.may_be_shown]
    assert allowed == ["bottle"]
    assert set(street.STREET) == {"fox", "castle", "fountain", "mouse", "temple", "monstree", "bust"}


def test_a_command_in_the_results_names_no_folder_of_this_machine(tmp_path: Path) -> None:
    folder = tmp_path / "draft" / "fox"
    words = reconstruct_command(folder / "photographs" / "fox", 50, folder / "run", "draft")
    told = typed(process([sys.executable, "-m", "gs2d", *words]), folder)
    assert told == "gs2d reconstruct OUT/draft/fox/photographs/fox --out OUT/draft/fox/run --quality draft"
