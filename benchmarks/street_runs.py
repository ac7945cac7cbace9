"""Run one capture from its photographs alone: start the command, measure it and score the result.

A run is ``gs2d reconstruct`` in its own process, so that exit code, CPU time and memory are those of a user's run. The
result is scored here, in the same way for every capture and every version of the program.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.json_files import read_json
from gs2d.core.mesh import Mesh
from gs2d.data import View
from gs2d.data.subject_box import find_subject
from gs2d.errors import DataError
from gs2d.evaluation.hidden_points import hidden_points
from gs2d.evaluation.image_metrics import ImageMetrics
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import MESH, METRICS, PAGE, REPORT, SPLATS
from gs2d.meshing.depth_maps import depth_map
from gs2d.meshing.evidence import gather, pixels
from gs2d.pipeline.finish.run_mesh import fusion_frame
from gs2d.pipeline.finish.run_subject import sights, surface_reach
from gs2d.pipeline.finish.scoring import score_views
from gs2d.pipeline.prepare.loaded import Trained, open_finished
from gs2d.pipeline.prepare.open_capture import FEW
from gs2d.pipeline.prepare.predicted_views import predicted
from gs2d.pipeline.reconstruct import CAPTURE
from gs2d.sfm.photos import find_photos
from gs2d.sfm.workspace import POSES_JSON
from gs2d.training.events import ignore

POLL_SECONDS = 0.2
PROCESS, CONSOLE, PHOTOS, PEER = "process.json", "console.txt", "photographs", "peer"
SAME_SURFACE = 0.01  # fraction of the scene's extent, tolerance between a mesh and a rendered depth
TEST_EVERY = 8  # for captures of which `reconstruct` would hold out nothing
UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0, "day": 86400.0, "days": 86400.0}
_DURATION = r"([\d.]+)\s*(s|min|h|days?)\b"


# -- processes -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Process:
    """Resources of a finished process, including its children.

    Attributes
    ----------
    exit_code : int
        Negative: the signal that ended it.
    seconds, cpu_seconds : float
        Wall and CPU time.
    cpu_seconds_before : float or None
        CPU time until the file ``when`` appeared; None if it never did.
    peak_rss_bytes : int
        Of the largest process among them.
    user_seconds : float
        Part of ``cpu_seconds`` spent in user mode; 0 in older files without this value.
    """

    command: list[str]
    exit_code: int
    seconds: float
    cpu_seconds: float
    cpu_seconds_before: float | None
    peak_rss_bytes: int
    user_seconds: float = 0.0


def watch_process(
    command: Sequence[str], console: Path, *, when: Path | None = None, environment: Mapping[str, str] | None = None
) -> Process:
    """Run a command to its end and write its output to a file.

    Parameters
    ----------
    when : Path, optional
        The CPU time is also recorded when this file appears.

    Raises
    ------
    OSError
        If the command cannot be started.
    """
    start, before = time.perf_counter(), None
    variables = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE", **(environment or {})}  # waiting threads use no CPU time
    with open(console, "w") as file:
        child = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, env=variables)
    try:
        while True:
            pid, status, used = os.wait4(child.pid, os.WNOHANG)
            if before is None and when is not None and when.exists():
                before = used.ru_utime + used.ru_stime if pid else _cpu_seconds_so_far(child.pid)
            if pid:
                break
            time.sleep(POLL_SECONDS)
    except BaseException:
        child.terminate()
        child.wait()
        raise
    child.returncode = os.waitstatus_to_exitcode(status)
    unit = 1 if sys.platform == "darwin" else 1024
    return Process(
        list(map(str, command)),
        child.returncode,
        round(time.perf_counter() - start, 2),
        round(used.ru_utime + used.ru_stime, 2),
        None if before is None else round(before, 2),
        used.ru_maxrss * unit,
        round(used.ru_utime, 2),
    )


def _cpu_seconds_so_far(pid: int) -> float | None:
    """Return the CPU time of a running process and its finished children; None if the system does not report it."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")  # user, system, and both of children


# -- a capture -----------------------------------------------------------------------------------------------------
def copy_images(source: Path, target: Path) -> int:
    """Copy the photographs of a folder to an empty folder; return their number.

    Raises
    ------
    DataError
        If there are none.
    """
    photos = find_photos(source)[0]
    target.mkdir(parents=True, exist_ok=True)
    for photo in photos:
        copy = target / photo.name
        if not copy.exists():
            shutil.copyfile(photo, copy)
    return len(photos)


def reconstruct_command(photos: Path, count: int, run: Path, quality: str, extra: Sequence[str] = ()) -> list[str]:
    """Return the command of one run, without ``gs2d``."""
    words = ["reconstruct", str(photos), "--out", str(run), "--quality", quality]
    if count < FEW and "--test-every" not in extra:
        words += ["--test-every", str(TEST_EVERY)]
    return [*words, *extra]


def run_reconstruct(source: Path, folder: Path, quality: str, extra: Sequence[str] = ()) -> tuple[Path, Process, int]:
    """Run the command for a capture unless finished; return run folder, resources and number of photographs."""
    run, process_file = folder / "run", folder / PROCESS
    photos = folder / PHOTOS / folder.name  # the report is named after its folder
    count = copy_images(source, photos)
    words = reconstruct_command(photos, count, run, quality, extra)
    if process_file.exists():
        before = Process(**json.loads(process_file.read_text()))
        if before.command[3:] == words:
            return run, before, count
    for left in (run, folder / PEER):  # an interrupted run, whose time is unknown, or a run of another command
        shutil.rmtree(left, ignore_errors=True)
    print("$ gs2d", " ".join(words), flush=True)
    process = watch_process([sys.executable, "-m", "gs2d", *words], folder / CONSOLE, when=run / CAPTURE / POSES_JSON)
    process_file.write_text(json.dumps(asdict(process), indent=1) + "\n")
    return run, process, count


# -- output and results --------------------------------------------------------------------------------------------
def told_estimate(console: str) -> dict[str, Any] | None:
    """Return the first training time estimate in a run's output: the line, and its bounds in seconds."""
    for line in console.splitlines():
        found = re.search(rf"will take about {_DURATION}(?:\s*(?:to|-)\s*{_DURATION})?", line)
        if found:
            low = float(found[1]) * UNITS[found[2]]
            high = float(found[3]) * UNITS[found[4]] if found[3] else low
            return {"line": line.strip(), "least": low, "most": high}
    return None


def estimate_error(estimate: Mapping[str, Any] | None, seconds: float | None) -> float | None:
    """Return the factor by which the time misses the estimate: 1 within the bounds, 2 for twice as long or half."""
    if estimate is None or not seconds:
        return None
    return max(1.0, seconds / estimate["most"], estimate["least"] / seconds)


def summary_of(scores: Mapping[str, ImageMetrics]) -> dict[str, Any] | None:
    """Return mean PSNR and SSIM and the worst view; None without views."""
    psnr = {name: score.psnr.value for name, score in scores.items() if score.psnr.value is not None}
    ssim = [score.ssim.value for score in scores.values() if score.ssim.value is not None]
    if not psnr or not ssim:
        return None
    worst = min(psnr, key=lambda name: psnr[name])
    return {
        "views": len(psnr),
        "psnr": round(sum(psnr.values()) / len(psnr), 3),
        "ssim": round(sum(ssim) / len(ssim), 4),
        "worst_psnr": round(psnr[worst], 3),
        "worst_view": worst,
        "psnr_by_view": {name: round(value, 3) for name, value in sorted(psnr.items())},
    }


def score_run(path: Path) -> dict[str, Any]:
    """Return scores of a run's splats: both splits, and hidden sparse points of test views.

    Test views use the exposure predicted from neighbouring training images, as in the run's own scores, and none in
    "test_plain".
    """
    run, job = open_finished(path, None, ignore)
    scene = predicted(job).scene

    def scores(views: Sequence[View]) -> dict[str, Any] | None:
        return summary_of(score_views(job, views, ignore))

    return {
        "test": scores(scene.test),
        "test_plain": scores(job.scene.test),
        "train": scores(scene.train),
        "hidden": hidden_fraction(job),
        "splats": len(job.splats),
        "downscale": run.definition()["downscale"],
        "pixels": [job.scene.views[0].camera.width, job.scene.views[0].camera.height],
    }


def hidden_fraction(job: Trained) -> dict[str, Any] | None:
    """Return the share of sparse points hidden by the median depth of test views; None without test views or points."""
    observed, hidden = job.scene.observed(guessed=False), {}
    if observed is None or not job.scene.test:
        return None
    for view in job.scene.test:
        depth = job.render(view.camera).depth_median.cpu().numpy()
        hidden[view.name] = hidden_points(np.asarray(depth), observed.in_view(view.name, view.camera))
    whole = np.concatenate(list(hidden.values()))
    if not len(whole):
        return None
    fractions = {name: float(found.mean()) for name, found in hidden.items() if len(found)}
    worst = max(fractions, key=lambda name: fractions[name])
    return {
        "points": len(whole),
        "share": round(float(whole.mean()), 5),
        "worst_share": round(fractions[worst], 5),
        "worst_view": worst,
    }


def placed(run: Path) -> dict[str, Any] | None:
    """Return the number of registered photographs and their cameras; None if there are none."""
    file = run / CAPTURE / POSES_JSON
    if not file.exists():
        return None
    poses = read_json(file)
    rows = poses["photographs"]
    return {
        "photographs": len(rows),
        "placed": sum(bool(row["placed"]) for row in rows),
        "cameras": poses.get("cameras"),
    }


def typed(process: Process, folder: Path) -> str:
    """Return the command as a user types it, with OUT for the results folder: results contain no local paths."""
    return " ".join(["gs2d", *process.command[3:]]).replace(str(folder.parent.parent), "OUT")


def measure_run(source: Path, folder: Path, quality: str, extra: Sequence[str] = ()) -> dict[str, Any]:
    """Run a capture unless finished, and tabulate its resources, output and scores."""
    folder.mkdir(parents=True, exist_ok=True)
    run, process, count = run_reconstruct(source, folder, quality, extra)
    row: dict[str, Any] = {
        "photographs": count,
        "poses": placed(run),
        **{name: value for name, value in asdict(process).items() if name != "command"},
        "command": typed(process, folder),
        "files": {name: (run / name).exists() for name in (SPLATS, MESH, REPORT, PAGE)},
    }
    if process.exit_code:
        row["last_lines"] = (folder / CONSOLE).read_text(errors="replace").splitlines()[-3:]
    row |= _times_of(run, folder)
    for name, file, measure in (("scores", SPLATS, score_run), ("mesh", MESH, measure_mesh)):
        row[name] = measure(run) if (run / file).exists() and (run / METRICS).exists() else None
    return row


def _times_of(run: Path, folder: Path) -> dict[str, Any]:
    """Return the training seconds and the estimate."""
    estimate = told_estimate((folder / CONSOLE).read_text(errors="replace"))
    stages = read_json(run / METRICS)["stages"] if (run / METRICS).exists() else []
    seconds = round(sum(stage["seconds"] for stage in stages), 1) if stages else None
    error = estimate_error(estimate, seconds)
    return {
        "iterations": sum(stage["iterations"] for stage in stages),
        "training_seconds": seconds,
        "estimate": estimate,
        "estimate_error": None if error is None else round(error, 2),
    }


def measure_mesh(path: Path) -> dict[str, Any]:
    """Return the size of a run's mesh, and the share of its area inside the bounding box of the cameras' subject.

    The box is computed from the splats by the current program, whatever box the run used or whether its mesh was
    cropped.
    """
    run, job = open_finished(path, None, ignore)
    mesh = read_mesh(run.file(MESH))
    facts: dict[str, Any] = {"faces": len(mesh.faces), "vertices": len(mesh.vertices)}
    facts["faces_per_pixel"] = round(len(mesh.faces) / max(pixels_of(job, mesh), 1.0), 3)
    try:
        subject = find_subject(sights(job))
    except DataError as error:
        return facts | {"subject": str(error), "share_in_subject": None}
    return facts | {"subject": subject.kind, "share_in_subject": round(fraction_in_box(mesh, subject.box), 4)}


def pixels_of(job: Trained, mesh: Mesh) -> float:
    """Return the number of training pixels that show a mesh; each part counts in the view that sees it best."""
    views = ((view, job.render(view.camera)) for view in job.scene.train)
    reach = surface_reach(job)
    maps = (depth_map(fusion_frame(job, view, output, "median", reach)) for view, output in views)
    return pixels(mesh, gather(mesh, maps, SAME_SURFACE * job.scene.extent))


def fraction_in_box(mesh: Mesh, box: np.ndarray) -> float:
    """Return the share of a mesh's area whose face centres lie in a box [2, 3]; 0 for a mesh without area."""
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middles = corners.mean(axis=1)
    inside = ((middles >= box[0]) & (middles <= box[1])).all(axis=1)
    return float(areas[inside].sum() / areas.sum()) if areas.sum() > 0 else 0.0
