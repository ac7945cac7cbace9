"""Iterations of all installed rasterizers on one capture, from the same splats and photographs.

Our training saves its splats at several points of its schedule. Every rasterizer then gets a process of its own, which
starts from each of them: an error of one, or a compilation that takes too long, does not end the others. Results of an
earlier call are kept, so the parts may be measured in several calls. ``--trainer`` adds whole trainings by the programs
of others, as command lines of the user.
"""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.gpu.bench import Bench, run_program
from benchmarks.gpu.kernels import REPEATS, WARMUP, bench_trainer, peer
from benchmarks.gpu.peers import PEERS, PeerIteration
from benchmarks.gpu.scenes import GpuScene
from gs2d.config.presets import get_recipe
from gs2d.config.schedule import scale_schedule
from gs2d.data import load_scene
from gs2d.data.known_captures import protocol_for
from gs2d.data.scene import Scene
from gs2d.evaluation.image_metrics import psnr_float
from gs2d.io.splat_ply import read_splats, write_splats
from gs2d.render.api import rasterize
from gs2d.training.trainer import Trainer, TrainerOptions

MINUTES = 25.0
PARTS = (0.1, 0.5, 1.0)  # of our schedule
VIEWS = 8  # training views, in turn
OURS = "gs2d"
RECIPE = "2dgs"
LAST_LINES = 5  # of a trainer's output: there it prints its time and scores
GRACE = 20.0  # s for a process to end by itself after its deadline


def parts(names: Sequence[str]) -> list[str]:
    """Return the parts whose name contains one of the words, ours first: the others need its splats."""
    return [name for name in (OURS, *PEERS) if not names or any(word in name for word in names)]


def run(
    bench: Bench,
    capture: Path,
    sizes: tuple[float, int],
    folder: Path,
    only: Sequence[str],
    trainers: Sequence[str],
    earlier: dict[str, Any],
    progress: Any,
) -> dict[str, Any]:
    """Measure each part in a process of its own; ``progress`` gets the document after each.

    ``sizes``: schedule scale and downscale. ``folder``: for splats. ``trainers``: ``NAME=COMMAND``. ``earlier``:
    results of an earlier call; those that failed or were left out are measured again.
    """
    found = {name: row for name, row in earlier.items() if not row.keys() & {"failed", "skipped"}}
    if not all(splat_file(folder, part).exists() for part in PARTS):
        found.pop(OURS, None)
    folder.mkdir(parents=True, exist_ok=True)
    waiting = [name for name in parts(only) if name not in found]
    jobs: list[tuple[str, str | None]] = [(name, None) for name in waiting]
    jobs += [(name, command) for name, _, command in (each.partition("=") for each in trainers)]
    for done, (name, command) in enumerate(jobs):
        left = bench.seconds_left(60 * MINUTES)
        share = left if name == OURS else left / (len(jobs) - done)
        if command is None:
            found[name] = bench.attempt(name, partial(_in_process, bench, name, capture, sizes, folder, share))
        elif name not in found:
            found[name] = bench.attempt(name, partial(whole_training, command, capture, folder / name, share))
        progress(found)
    return found


def splat_file(folder: Path, part: float) -> Path:
    """Return the file of the splats after a part of our schedule."""
    return folder / f"splats_{part:g}.ply"


def _in_process(
    bench: Bench, name: str, capture: Path, sizes: tuple[float, int], folder: Path, seconds: float
) -> dict[str, Any]:
    """Measure one part in another process; return what it wrote, even if it did not get to its end."""
    out = folder / f"{name}.json"
    out.unlink(missing_ok=True)
    words = [sys.executable, "-m", "benchmarks.gpu", "peers", "--one", name, "--capture", str(capture)]
    words += ["--runs", str(folder), "--out", str(out), "--minutes", str(seconds / 60)]
    words += ["--schedule-scale", str(sizes[0]), "--downscale", str(sizes[1]), *(["--dry-run"] if bench.dry else [])]
    done = run_program(words, seconds=seconds + GRACE)
    row: dict[str, Any] = json.loads(out.read_text())["results"].get(name, {}) if out.exists() else {}
    if done.exit != 0 and "failed" not in row:
        how = "ran out of time" if done.exit is None else f"ended with {done.exit}"
        row["failed"] = f"its process {how}: {(done.lines or ['no output'])[-1]}"
    return row


def whole_training(command: str, capture: Path, out: Path, seconds: float) -> dict[str, Any]:
    """Run a trainer, with ``{capture}`` and ``{out}`` replaced; return its seconds and the end of its output."""
    began = time.perf_counter()
    words = [word.format(capture=capture.resolve(), out=out.resolve()) for word in shlex.split(command)]
    done = run_program(words, seconds=seconds)
    row = {"command": command, "seconds": round(time.perf_counter() - began, 2), "exit": done.exit}
    return row | {"last_lines": done.lines[-LAST_LINES:]} | ({} if done.exit == 0 else {"failed": "see last_lines"})


def measure(
    bench: Bench, name: str, capture: Path, sizes: tuple[float, int], folder: Path, progress: Any
) -> dict[str, Any]:
    """Measure one part in this process; ``progress`` gets the document after each number of splats."""
    scene, rows = load_scene(capture, downscale=sizes[1]), {}
    found: dict[str, Any] = {name: rows}

    def work() -> dict[str, Any]:
        if name == OURS:
            rows["training"] = _train(bench, scene, sizes[0], folder)
            progress(found)
        else:
            PEERS[name]()  # the reason, if it is not here, before anything else
        for part in PARTS:
            splats = read_splats(splat_file(folder, part)).to(bench.device)
            step = max(1, len(scene.train) // VIEWS)
            views = scene.train[::step][: 1 if bench.dry else VIEWS]
            targets = [torch.from_numpy(view.target((0.0, 0.0, 0.0)).copy()).to(bench.device) for view in views]
            seen = GpuScene(scene.name, splats, tuple(view.camera for view in views))
            timed = _ours(bench, seen, targets) if name == OURS else peer(bench, seen, targets, name)
            rows[f"{part:g}"] = {"splats": len(splats), "psnr": _psnr(bench, name, seen, targets), **timed}
            progress(found)
        return {}

    rows |= bench.attempt(name, work)
    return found


def _train(bench: Bench, scene: Scene, scale: float, folder: Path) -> dict[str, Any]:
    """Train our recipe and save its splats; return seconds of training with its start, and PSNR of the test views."""
    recipe = scale_schedule(get_recipe(RECIPE), scale)
    recipe = replace(recipe, init_points=60) if bench.dry else recipe
    protocol = protocol_for(scene.format)
    began, written = time.perf_counter(), 0.0
    trainer = Trainer(scene, recipe, protocol, backend=bench.backend, options=TrainerOptions(progress_every=50))
    trainer.enter(0)
    for part in PARTS:
        while trainer.state.step < round(part * recipe.stages[0].iterations):
            trainer.step()
        bench.wait()
        start = time.perf_counter()
        write_splats(splat_file(folder, part), trainer.splats)
        written += time.perf_counter() - start
    row = {"recipe": RECIPE, "iterations": trainer.state.step, "splats": len(trainer.splats)}
    row["seconds"] = round(time.perf_counter() - began - written, 2)
    cameras = tuple(view.camera for view in scene.test or scene.train)
    targets = [torch.from_numpy(view.target(protocol.background).copy()) for view in scene.test or scene.train]
    shown = (rasterize(trainer.splats, camera, trainer.settings, backend=bench.backend).color for camera in cameras)
    scores = [psnr_float(image.cpu(), target) for image, target in zip(shown, targets, strict=True)]
    return row | {"psnr": round(sum(scores) / len(scores), 3)}


def _ours(bench: Bench, scene: GpuScene, targets: list[Tensor]) -> dict[str, Any]:
    trainer = bench_trainer(bench, scene, targets, stages=1)
    trainer.enter(0)
    for _ in scene.cameras:
        trainer.step()  # every training image has been loaded
    return {
        "iteration_ms": bench.times(lambda _: trainer.step(), repeats=REPEATS, warmup=WARMUP),
        "peak_bytes": bench.peak_memory(trainer.step),
    }


def _psnr(bench: Bench, name: str, scene: GpuScene, targets: list[Tensor]) -> float:
    """Return the mean PSNR of the splats as this rasterizer draws them: low if it draws something else."""
    with torch.no_grad():
        if name == OURS:
            drawn = [rasterize(scene.splats, camera, backend=bench.backend).color for camera in scene.cameras]
        else:
            theirs = PeerIteration(PEERS[name](), scene.splats, targets)
            drawn = [theirs.forward(camera).color for camera in scene.cameras]
    scores = [psnr_float(image, target) for image, target in zip(drawn, targets, strict=True)]
    return round(sum(scores) / len(scores), 3)


def table(found: dict[str, Any]) -> list[str]:
    """Return a line for each part: milliseconds of an iteration at each number of splats."""
    lines = []
    for name, row in found.items():
        numbers = [
            f"{each['splats']} splats: {each['iteration_ms']['median']} ms, {each['psnr']} dB"
            for each in row.values()
            if isinstance(each, dict) and "iteration_ms" in each
        ]
        whole = row.get("training", row)
        numbers += [f"training {whole['seconds']} s"] if "seconds" in whole else []
        numbers += [row[why] for why in ("failed", "skipped") if why in row]
        lines.append(f"{name}: {'; '.join(numbers)}")
    return lines
