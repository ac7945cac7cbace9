"""A peer on the photographs and cameras of a run, for no more processor time: OpenSplat, 3D Gaussian splatting.

The binary is the user's own build (``docs/notebook/real-captures.md`` says how); nothing of it is in this repository.
It trains on our cameras, on the undistorted training views of the run, at the run's size. So that it shows the
best it can:

- It knows no principal point: each picture is cut, or a canvas is laid around it, so that this point is in the middle.
- It knows no masks of single pixels: training pictures are cut to where the undistorted photograph has pixels.
- Its schedule is made for 30,000 iterations: it is scaled to those it gets. It refines at most every
  50 iterations, because ten views are rendered each time.
- In the second half of a training, where it refines no more, its optimizer moves every 32nd, then every 64th iteration
  only. That is made for long trainings; in a short one it is two dozen steps. So it is trained twice, each time for all
  the seconds: as it is ("own"), and refining after each tenth but the last, so that it always moves ("moving"). The
  better one counts.

Its pictures of the test views are drawn by itself. It draws a view that it leaves out of training in every tenth
iteration, and its optimizer moves every 32nd (64th): after a multiple of 64 iterations it can be resumed for ten more,
in which nothing changes, with each test view left out in turn.
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
from gs2d.pipeline.prepare.run_appearance import matched_by_halves
from gs2d.training.events import ignore

OWN_ITERATIONS = 30_000
OWN = {"refine-every": 500, "densify-from": 500, "sh-degree-interval": 1000}  # of 30,000 iterations
LEAST = {"refine-every": 50, "densify-from": 1, "sh-degree-interval": 1}
MOVES_EVERY, DRAWS_EVERY = 64, 10  # iterations
PROBE = 4 * MOVES_EVERY
ENOUGH, TRIES, CAUTION = 0.8, 4, 0.95  # share of the budget to use, trainings to find how, and what is aimed at
TRAIN, ALL, SPLATS = "train", "all", "splat.ply"
OWN_SCHEDULE, MOVING = "own", "moving"
VARIANTS = (OWN_SCHEDULE, MOVING)
REFINED = 10  # parts of a training, after each of which but the last "moving" refines


# -- what it is given ----------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Window:
    """A part of a view's pixels, or a canvas around them: its corner in the view, and its size, px."""

    x: int
    y: int
    width: int
    height: int

    def cut(self, image: np.ndarray) -> np.ndarray:
        """The pixels [height, width, C] of an image; black where it has none."""
        out = np.zeros((self.height, self.width, *image.shape[2:]), dtype=image.dtype)
        (a, b, i, j), (c, d, k, m) = (self._overlap(*span) for span in self._spans(image))
        out[c:d, a:b] = image[k:m, i:j]
        return out

    def place(self, image: np.ndarray, height: int, width: int) -> np.ndarray:
        """The reverse of :meth:`cut`: an image [height, width, C] with these pixels; black elsewhere."""
        out = np.zeros((height, width, *image.shape[2:]), dtype=image.dtype)
        (a, b, i, j), (c, d, k, m) = (self._overlap(*span) for span in self._spans(out))
        out[k:m, i:j] = image[c:d, a:b]
        return out

    def _spans(self, image: np.ndarray) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
        return (self.x, self.width, image.shape[1]), (self.y, self.height, image.shape[0])

    @staticmethod
    def _overlap(start: int, size: int, whole: int) -> tuple[int, int, int, int]:
        """First and last pixel of what both have: in the window, in the image."""
        low, high = max(start, 0), min(start + size, whole)
        return low - start, max(high - start, low - start), low, max(high, low)

    def camera(self, camera: Camera) -> Camera:
        """The camera of these pixels."""
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
    """The smallest window around a whole view whose middle is the principal point, to a quarter of a pixel."""
    spans = [_centred(c, max(c, size - c)) for c, size in ((camera.cx, camera.width), (camera.cy, camera.height))]
    return Window(spans[0][0], spans[1][0], spans[0][1], spans[1][1])


def _centred(middle: float, reach: float) -> tuple[int, int]:
    """First pixel and size of a span around ``middle`` that reaches at least so far on both sides."""
    twice = round(2 * middle)
    half = math.ceil(2 * reach - 1e-6 + abs(2 * middle - twice))
    half += (half - twice) % 2  # the first pixel is a whole number
    return (twice - half) // 2, half


def seen_window(camera: Camera, mask: np.ndarray | None) -> Window:
    """The largest window with the canvas's middle and shape in which every pixel of a view counts.

    Raises
    ------
    DataError
        There is none.
    """
    whole = canvas(camera)
    good = whole.cut(np.ones((camera.height, camera.width), dtype=bool) if mask is None else mask)
    low, high = 0, min(whole.width, whole.height) // 2 - 1  # px cut from the shorter sides; more of them is safer
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if _is_full(_inset(whole, middle), whole, good) else (middle + 1, high)
    window = _inset(whole, low)
    if not _is_full(window, whole, good):
        raise DataError("a view has no whole rectangle of pixels around its principal point")
    return window


def _is_full(window: Window, whole: Window, good: np.ndarray) -> bool:
    """Whether every pixel of a window is good; ``good`` is [whole.height, whole.width]."""
    top, left = window.y - whole.y, window.x - whole.x
    return bool(good[top : top + window.height, left : left + window.width].all())


def _inset(whole: Window, by: int) -> Window:
    """A window with ``by`` pixels less on its shorter sides, and as large a share less on the others."""
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
    """Views in COLMAP's layout: PNG pictures and binary model, a pinhole camera each, and the scene's sparse points.

    The peer knows no alpha: photographs that have it are laid over ``background``.
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
    """A name of its own for a view's picture, whatever folders and endings the views have."""
    return f"{number:04d}-{Path(view.name).stem}.png"


def _points(scene: Scene) -> bytes:
    """``points3D.bin`` of the scene's sparse points, without tracks."""
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


# -- what it does --------------------------------------------------------------------------------------------------
def schedule(iterations: int, variant: str) -> list[str]:
    """Its options for so many iterations: its own schedule of 30,000, scaled; "moving" as the module says."""
    scaled = {name: max(LEAST[name], round(value * iterations / OWN_ITERATIONS)) for name, value in OWN.items()}
    words = ["-n", str(iterations)]
    if variant == MOVING:
        scaled["refine-every"] = max(LEAST["refine-every"], iterations // REFINED + 1)  # never in the last tenth
        words += ["--densify-until", str(iterations)]
    return words + [word for name, value in scaled.items() for word in (f"--{name}", str(value))]


def train_command(binary: Path, capture: Path, out: Path, iterations: int, variant: str) -> list[str]:
    """A training of the peer."""
    return [str(binary), str(capture), "--cpu", "-o", str(out), *schedule(iterations, variant)]


def draw_command(binary: Path, capture: Path, splats: Path, iterations: int, name: str, out: Path) -> list[str]:
    """Draw one view with splats of so many iterations, a multiple of 64; nothing of them changes."""
    last = iterations + DRAWS_EVERY - iterations % DRAWS_EVERY
    words = [str(binary), str(capture), "--cpu", "--resume", str(splats), "-o", str(out / SPLATS)]
    words += schedule(iterations, OWN_SCHEDULE)
    words[words.index("-n") + 1] = str(last)
    return [*words, "--densify-until", "0", "--val-image", name, "--val-render", str(out)]


def whole_steps(iterations: float) -> int:
    """The largest number of iterations after which it can be drawn, at least one step of its optimizer."""
    return max(1, int(iterations // MOVES_EVERY)) * MOVES_EVERY


@dataclass(frozen=True)
class Trained:
    """A training of the peer that kept to the budget."""

    iterations: int
    process: Process


def train_within(binary: Path, capture: Path, folder: Path, budget: float, variant: str) -> Trained:
    """Train for as many iterations as fit into ``budget`` seconds of the processor.

    A short training tells what an iteration costs; its schedule is scaled like that of the long one, so that it grows
    alike. A training that took more than the budget does not count.

    Raises
    ------
    DataError
        The peer failed, or does not fit into the budget at all.
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
    """Run the peer to its end, what it says going to ``NUMBER-console.txt`` in a folder.

    Raises
    ------
    DataError
        It failed.
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
    """Its pictures of the test views, cut to the views' pixels; files that are there are not drawn again."""
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
    """Our metrics of pictures of the test views, as they are and with colours matched."""
    plain: dict[str, ImageMetrics] = {}
    matched: dict[str, ImageMetrics] = {}
    background = job.settings.background
    for view, file in zip(job.scene.test, files, strict=True):
        image = torch.from_numpy(np.asarray(Image.open(file).convert("RGB"), dtype=np.float32) / 255)
        target = torch.from_numpy(np.asarray(view.target(background), dtype=np.float32))
        pixels = view.mask()
        mask = None if pixels is None else torch.from_numpy(pixels)
        plain[view.name] = image_metrics(image, target, mask, backend=job.backend)
        image = matched_by_halves(view, image, target, mask, background)
        matched[view.name] = image_metrics(image, target, mask, backend=job.backend)
    return {"test": summary_of(plain), "test_matched": summary_of(matched)}


def measure_peer(
    binary: Path, run: Path, folder: Path, budget: float, variants: Sequence[str] = VARIANTS
) -> dict[str, Any]:
    """Train the peer on a run's capture, each variant for at most ``budget`` seconds of the processor, and score it.

    Returns
    -------
    dict
        The row of the variant with the higher PSNR of test views, and those of all of them.

    Raises
    ------
    DataError
    """
    _, job, _ = open_finished(run, None, ignore)
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
    """What a training took; one that was finished before is not repeated, if it kept to the budget."""
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
    """The number of vertices that a PLY's header tells."""
    with open(ply, "rb") as file:
        for line in file:
            if line.startswith(b"element vertex "):
                return int(line.split()[2])
    raise DataError(f"{ply} has no vertices")
