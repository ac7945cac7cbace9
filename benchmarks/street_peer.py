"""Train OpenSplat (3D Gaussian splatting) on the images and cameras of a run, within the run's CPU time.

The binary is the user's own build (see ``docs/notebook/real-captures.md``); this repository contains no OpenSplat code.
OpenSplat trains on our cameras and the undistorted training views, at the run's image size. Several adjustments let it
perform at its best:

- It does not support a principal point: images are cropped or padded so that the principal point is in the centre.
- It does not support pixel masks: training images are cropped to the valid region of the undistorted photograph.
- Its schedule is designed for 30,000 iterations and is scaled to the available iterations. It refines at most every
  50 iterations, because it renders ten views each time.
- In the second half of a training, it does not refine and its optimizer steps only every 32nd, later every 64th
  iteration. In a short training these are only about two dozen steps. OpenSplat is therefore trained twice, each time
  with the full budget: unchanged ("own"), and refining after every tenth of the training except the last, so that the
  optimizer always steps ("moving"). The better result counts.

OpenSplat renders the test views itself. It renders a view that is left out of training every ten iterations, and its
optimizer steps every 32nd (64th) iteration. After a multiple of 64 iterations it is therefore resumed for ten
iterations, which change nothing, once per left-out test view.
"""

from __future__ import annotations

import json
import math
import shutil
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.street_runs import Process, summary_of, watch_process
from gs2d.core.camera import Camera
from gs2d.data import Scene, View
from gs2d.data.image_files import read_image, write_image
from gs2d.errors import DataError
from gs2d.evaluation.image_metrics import ImageMetrics, image_metrics
from gs2d.pipeline.prepare.loaded import LoadedRun, open_finished
from gs2d.training.events import ignore

OWN_ITERATIONS = 30_000
OWN = {"refine-every": 500, "densify-from": 500, "sh-degree-interval": 1000}  # of 30,000 iterations
LEAST = {"refine-every": 50, "densify-from": 1, "sh-degree-interval": 1}
MOVES_EVERY, DRAWS_EVERY = 64, 10  # iterations
PROBE = 4 * MOVES_EVERY
ENOUGH, TRIES, CAUTION = 0.8, 4, 0.95  # share of the budget to use, number of calibration trainings, and target share
TRAIN, ALL, SPLATS = "train", "all", "splat.ply"
OWN_SCHEDULE, MOVING = "own", "moving"
VARIANTS = (OWN_SCHEDULE, MOVING)
REFINED = 10  # number of segments of a training; "moving" refines after each except the last


# -- inputs --------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Window:
    """Crop of a view or a canvas around it: its corner in the view, and its size, px."""

    x: int
    y: int
    width: int
    height: int

    def cut(self, image: np.ndarray) -> np.ndarray:
        """Return the pixels [height, width, C] of the window; black outside the image."""
        out = np.zeros((self.height, self.width, *image.shape[2:]), dtype=image.dtype)
        (a, b, i, j), (c, d, k, m) = (self._overlap(*span) for span in self._spans(image))
        out[c:d, a:b] = image[k:m, i:j]
        return out

    def place(self, image: np.ndarray, height: int, width: int) -> np.ndarray:
        """Invert :meth:`cut`: return an image [height, width, C] with these pixels; black elsewhere."""
        out = np.zeros((height, width, *image.shape[2:]), dtype=image.dtype)
        (a, b, i, j), (c, d, k, m) = (self._overlap(*span) for span in self._spans(out))
        out[k:m, i:j] = image[c:d, a:b]
        return out

    def _spans(self, image: np.ndarray) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
        return (self.x, self.width, image.shape[1]), (self.y, self.height, image.shape[0])

    @staticmethod
    def _overlap(start: int, size: int, whole: int) -> tuple[int, int, int, int]:
        """Return first and last pixel of the overlap, in the window and in the image."""
        low, high = max(start, 0), min(start + size, whole)
        return low - start, max(high - start, low - start), low, max(high, low)

    def camera(self, camera: Camera) -> Camera:
        """Return the camera of the window."""
        return Camera(
            self.width,
            self.height,
            camera.fx,
            camera.fy,
            camera.cx - self.x,
            camera.cy - self.y,
            camera.T_cam_world,
        )


def canvas(camera: Camera) -> Window:
    """Return the smallest window around a whole view centred at the principal point, to a quarter of a pixel."""
    spans = [_centred(c, max(c, size - c)) for c, size in ((camera.cx, camera.width), (camera.cy, camera.height))]
    return Window(spans[0][0], spans[1][0], spans[0][1], spans[1][1])


def _centred(middle: float, reach: float) -> tuple[int, int]:
    """Return first pixel and size of the smallest span centred at ``middle`` that covers the view."""
    twice = round(2 * middle)
    half = math.ceil(2 * reach - 1e-6 + abs(2 * middle - twice))
    half += (half - twice) % 2  # the first pixel must be an integer
    return (twice - half) // 2, half


def seen_window(camera: Camera, mask: np.ndarray | None) -> Window:
    """Return the largest window with the canvas's centre and shape that has only valid pixels.

    Raises
    ------
    DataError
        If there is none.
    """
    whole = canvas(camera)
    good = whole.cut(np.ones((camera.height, camera.width), dtype=bool) if mask is None else mask)
    low, high = 0, min(whole.width, whole.height) // 2 - 1  # px cropped from the shorter sides; larger values are safer
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if _is_full(_inset(whole, middle), whole, good) else (middle + 1, high)
    window = _inset(whole, low)
    if not _is_full(window, whole, good):
        raise DataError("a view has no whole rectangle of pixels around its principal point")
    return window


def _is_full(window: Window, whole: Window, good: np.ndarray) -> bool:
    """Return True if every pixel of a window is valid; ``good`` is [whole.height, whole.width]."""
    top, left = window.y - whole.y, window.x - whole.x
    return bool(good[top : top + window.height, left : left + window.width].all())


def _inset(whole: Window, by: int) -> Window:
    """Return a window cropped by ``by`` pixels on its shorter sides, and proportionally on the others."""
    shorter = min(whole.width, whole.height)
    dx, dy = (round(by * size / shorter) for size in (whole.width, whole.height))
    return Window(whole.x + dx, whole.y + dy, whole.width - 2 * dx, whole.height - 2 * dy)


def write_capture(
    folder: Path,
    scene: Scene,
    views: Sequence[View],
    windows: Sequence[Window],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> None:
    """Write views in COLMAP's layout: PNG images, a binary model with one pinhole camera each, and the sparse points.

    OpenSplat does not support alpha: photographs with alpha are composited over ``background``.
    """
    model = folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    cameras, images = [struct.pack("<Q", len(views))], [struct.pack("<Q", len(views))]
    for number, (view, window) in enumerate(zip(views, windows, strict=True), start=1):
        name, camera = image_name(number, view), window.camera(view.camera)
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, window.cut(np.rint(view.target(background) * 255).astype(np.uint8)))
        cameras.append(struct.pack("<IiQQ", number, 1, camera.width, camera.height))
        cameras.append(struct.pack("<4d", camera.fx, camera.fy, camera.cx, camera.cy))
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        pose = struct.pack("<I7dI", number, w, x, y, z, *camera.T_cam_world[:3, 3], number)
        images.append(pose + name.encode() + b"\0" + struct.pack("<Q", 0))
    (model / "cameras.bin").write_bytes(b"".join(cameras))
    (model / "images.bin").write_bytes(b"".join(images))
    (model / "points3D.bin").write_bytes(_points(scene))


def image_name(number: int, view: View) -> str:
    """Return a unique image name for a view, independent of its folder and file extension."""
    return f"{number:04d}-{Path(view.name).stem}.png"


def _points(scene: Scene) -> bytes:
    """Return ``points3D.bin`` of the scene's sparse points, without tracks."""
    if scene.points is None:
        raise DataError("the capture has no sparse points for the peer to start from")
    colors = scene.points.colors
    rows = np.zeros(
        len(scene.points),
        dtype=[("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")],
    )
    rows["id"] = np.arange(1, len(rows) + 1)
    rows["xyz"] = scene.points.points
    rows["rgb"] = 128 if colors is None else colors
    return struct.pack("<Q", len(rows)) + rows.tobytes()


# -- commands and runs ---------------------------------------------------------------------------------------------
def schedule(iterations: int, variant: str) -> list[str]:
    """Return OpenSplat's options for this many iterations: its 30,000-iteration schedule, scaled; "moving" as above."""
    scaled = {name: max(LEAST[name], round(value * iterations / OWN_ITERATIONS)) for name, value in OWN.items()}
    words = ["-n", str(iterations)]
    if variant == MOVING:
        scaled["refine-every"] = max(LEAST["refine-every"], iterations // REFINED + 1)  # never in the last tenth
        words += ["--densify-until", str(iterations)]
    return words + [word for name, value in scaled.items() for word in (f"--{name}", str(value))]


def train_command(binary: Path, capture: Path, out: Path, iterations: int, variant: str) -> list[str]:
    """Return the training command."""
    return [str(binary), str(capture), "--cpu", "-o", str(out), *schedule(iterations, variant)]


def draw_command(binary: Path, capture: Path, splats: Path, iterations: int, name: str, out: Path) -> list[str]:
    """Return the command that renders one view with splats of a multiple of 64 iterations, without changing them."""
    last = iterations + DRAWS_EVERY - iterations % DRAWS_EVERY
    words = [str(binary), str(capture), "--cpu", "--resume", str(splats), "-o", str(out / SPLATS)]
    words += schedule(iterations, OWN_SCHEDULE)
    words[words.index("-n") + 1] = str(last)
    return [*words, "--densify-until", "0", "--val-image", name, "--val-render", str(out)]


def whole_steps(iterations: float) -> int:
    """Return the largest number of iterations after which a view can be rendered, at least one optimizer step."""
    return max(1, int(iterations // MOVES_EVERY)) * MOVES_EVERY


@dataclass(frozen=True)
class Trained:
    """OpenSplat training that stayed within the budget."""

    iterations: int
    process: Process


def train_within(binary: Path, capture: Path, folder: Path, budget: float, variant: str) -> Trained:
    """Train for as many iterations as fit into ``budget`` CPU seconds.

    A short training, with its schedule scaled in the same way, measures the cost of an iteration. A training that
    exceeds the budget is discarded.

    Raises
    ------
    DataError
        If OpenSplat fails, or if no training fits into the budget.
    """
    iterations, best = PROBE, None
    for attempt in range(TRIES):
        made = folder / f"{attempt}-{SPLATS}"
        process = run_peer(train_command(binary, capture, made, iterations, variant), folder, attempt)
        if process.cpu_seconds <= budget and (best is None or iterations > best.iterations):
            best = Trained(iterations, process)
            shutil.move(made, folder / SPLATS)
        print(f"  peer, {variant}: {iterations} iterations, {process.cpu_seconds:.0f} of {budget:.0f} CPU seconds")
        following = whole_steps(CAUTION * iterations * budget / process.cpu_seconds)
        if following == iterations or (best and best.process.cpu_seconds >= ENOUGH * budget):
            break
        iterations = following
    if best is None:
        raise DataError(f"the peer needs more than {budget:.0f} s of the processor for {iterations} iterations")
    return best


def run_peer(
    command: Sequence[str], folder: Path, number: int | str, environment: Mapping[str, str] | None = None
) -> Process:
    """Run OpenSplat to its end and write its output to ``NUMBER-console.txt`` in a folder.

    Raises
    ------
    DataError
        If it fails.
    """
    console = folder / f"{number}-console.txt"
    process = watch_process(command, console, environment=environment)
    if process.exit_code:
        said = console.read_text(errors="replace").strip().splitlines()[-1:]
        raise DataError(f"the peer ended with exit code {process.exit_code}: {said}")
    return process


def draw_test_views(
    binary: Path, capture: Path, folder: Path, scene: Scene, windows: Sequence[Window], iterations: int
) -> list[Path]:
    """Return OpenSplat's renderings of the test views, cropped to the views' pixels; existing files are kept."""
    files, images = [], folder / "renders"
    for number, view in list(enumerate(scene.views, start=1))[len(scene.train) :]:
        name, file = image_name(number, view), images / f"{number:04d}.png"
        files.append(file)
        if file.exists():
            continue
        out = folder / "draw"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        run_peer(draw_command(binary, capture, folder / SPLATS, iterations, name, out), folder, "draw")
        drawn = sorted(out.glob("[0-9]*.png"))
        if len(drawn) != 1:
            raise DataError(f"the peer drew {len(drawn)} pictures of {view.name}, expected 1")
        camera = view.camera
        images.mkdir(exist_ok=True)
        write_image(file, windows[number - 1].place(read_image(drawn[0]), camera.height, camera.width))
        shutil.rmtree(out)
    return files


def score_images(job: LoadedRun, files: Sequence[Path]) -> dict[str, Any]:
    """Return our metrics of test view images."""
    plain: dict[str, ImageMetrics] = {}
    background = job.settings.background
    for view, file in zip(job.scene.test, files, strict=True):
        image = torch.from_numpy(np.asarray(Image.open(file).convert("RGB"), dtype=np.float32) / 255)
        target = torch.from_numpy(np.asarray(view.target(background), dtype=np.float32))
        pixels = view.mask()
        mask = None if pixels is None else torch.from_numpy(pixels)
        plain[view.name] = image_metrics(image, target, mask, backend=job.backend)
    return {"test": summary_of(plain)}


def measure_peer(
    binary: Path, run: Path, folder: Path, budget: float, variants: Sequence[str] = VARIANTS
) -> dict[str, Any]:
    """Train OpenSplat on a run's capture, each variant for at most ``budget`` CPU seconds, and score it.

    Returns
    -------
    dict
        Row of the variant with the higher test PSNR, and the rows of all variants.

    Raises
    ------
    DataError
        If OpenSplat fails, or a training does not fit into the budget.
    """
    _, job = open_finished(run, None, ignore)
    scene, whole = job.scene, folder / "whole.json"
    around = [canvas(view.camera) for view in scene.views]
    if not whole.exists():
        shutil.rmtree(folder, ignore_errors=True)
        seen = [seen_window(view.camera, view.mask()) for view in scene.train]
        write_capture(folder / TRAIN, scene, scene.train, seen)
        write_capture(folder / ALL, scene, scene.views, around)
        whole.write_text("{}\n")
    rows = {}
    for variant in variants:
        place = folder / variant
        trained = _trained(binary, folder / TRAIN, place, budget, variant)
        files = draw_test_views(binary, folder / ALL, place, scene, around, trained["iterations"])
        facts = {name: trained[name] for name in ("iterations", "cpu_seconds", "seconds", "peak_rss_bytes")}
        rows[variant] = {**facts, "gaussians": vertices_of(place / SPLATS), "scores": score_images(job, files)}
    best = max(rows, key=lambda name: (rows[name]["scores"]["test"] or {"psnr": 0.0})["psnr"])
    return {"variant": best, "cpu_seconds_allowed": round(budget, 2), **rows[best], "variants": rows}


def _trained(binary: Path, capture: Path, folder: Path, budget: float, variant: str) -> dict[str, Any]:
    """Return a training; a finished one that stayed within the budget is reused."""
    file = folder / "trained.json"
    if file.exists():
        before = dict(json.loads(file.read_text()))
        if before["budget"] == round(budget, 2):
            return before
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    found = train_within(binary, capture, folder, budget, variant)
    trained = {"budget": round(budget, 2), "iterations": found.iterations, **asdict(found.process)}
    file.write_text(json.dumps(trained, indent=1) + "\n")
    return trained


def vertices_of(ply: Path) -> int:
    """Return the number of vertices in a PLY header."""
    with open(ply, "rb") as file:
        for line in file:
            if line.startswith(b"element vertex "):
                return int(line.split()[2])
    raise DataError(f"{ply} has no vertices")
