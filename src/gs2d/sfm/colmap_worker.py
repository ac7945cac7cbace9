"""The process in which COLMAP runs: ``python -m gs2d.sfm.colmap_worker REQUEST.json``. It never loads torch.

It is a separate process because a crash of a native library must not end the command, because Ctrl-C must not wait for
a native call of several minutes, and because torch and pycolmap each load an OpenMP library. It writes one JSON object
per line to stdout and ends when its stdin is closed, which happens when its parent ends for any reason.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.similarity import rotation_to_z
from gs2d.sfm.compare import device_of, find_features, match
from gs2d.sfm.lens import PANORAMA, RICH, START, settle_fisheyes, with_rich_lenses
from gs2d.sfm.mapping import Steps, extend, map_globally, map_incrementally
from gs2d.sfm.search import FISHEYES, MAPPING

MIN_AGREEMENT = 0.3  # smallest length of the mean of the cameras' up vectors
_TOWARDS_MEAN = 0.01  # decides if all right vectors are parallel, negligible otherwise
Say = Callable[..., None]
REPEATABLE = 50  # images: up to this many, one thread places them and the same seed gives the same bytes
SMALLEST_MODEL = 3  # images: smaller models cannot be trained
# Thresholds for the first image pair, tried in this order until enough images are placed. COLMAP asks for 16 degrees
# between the two views and no motion along the viewing direction, which a walk straight ahead never fulfils.
ATTEMPTS: dict[str, dict[str, float]] = {
    "strictly": {},
    "as on a walk": {"init_max_forward_motion": 1.0, "init_min_tri_angle": 4.0},
}
AT_ONCE = "all at once"  # the global mapper
ENOUGH = 0.5  # of the images in one model: no further attempt
CLEARLY = 1.5  # factor by which a looser attempt must place more images to replace a stricter one


def up_direction(rotations: np.ndarray) -> np.ndarray | None:
    """Return the up direction as a unit vector [3] in the world; None if the cameras do not agree.

    Photographers hold the camera level but tilt it up and down, so up is perpendicular to the cameras' x axes r_i: the
    unit vector u that minimises mean((r_i . u)^2) - 0.01 (m . u)^2, where m is the mean of the cameras' up vectors.
    ``rotations`` [V, 3, 3]: world to camera, OpenCV axes: rows are the camera's right, down and forward in the world.
    """
    right, mean_up = rotations[:, 0], -rotations[:, 1].mean(axis=0)
    if np.linalg.norm(mean_up) < MIN_AGREEMENT:
        return None
    spread = right.T @ right / len(right) - _TOWARDS_MEAN * np.outer(mean_up, mean_up)
    up = np.linalg.eigh(spread)[1][:, 0]
    return np.asarray(up if up @ mean_up > 0 else -up)


def main(request_path: str) -> None:
    """Find features, match, map; write the models, largest first, to ``output/0``, ``output/1`` ..."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole process group; the parent decides
    say = _messages()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    request = json.loads(Path(request_path).read_text(encoding="utf-8"))
    import pycolmap

    pycolmap.logging.logtostderr = True  # otherwise it writes log files to the temporary folder
    pycolmap.logging.minloglevel = int(pycolmap.logging.WARNING)
    pycolmap.set_random_seed(request["seed"])
    steps = Steps(Path(request["database"]).with_name(MAPPING))
    if steps.result("first") is None:
        if device_of(pycolmap, request) != pycolmap.Device.cpu:
            say(gpu=True)
        find_features(pycolmap, request, say)
        match(pycolmap, request, say)
    say(**map_(pycolmap, request, steps, say))


def map_(pycolmap: Any, request: dict[str, Any], steps: Steps, say: Say) -> dict[str, Any]:
    """Estimate cameras and points from the matches; each connected set of images becomes a model.

    Each step reads the result of the step before it and is skipped if it is already finished. The result has
    ``models``, the statistics of each model, largest first, and ``lens``, the lens that was chosen.
    """
    if steps.result(FISHEYES) is None:
        settle_fisheyes(pycolmap, request, steps, say)
    if steps.result("first") is None:
        steps.finish("first", _first_models(pycolmap, request, steps, say))
    names = steps.result("first") or []
    lens: dict[str, Any] = {}
    if names:
        if steps.result("lens") is None:
            _settle_lens(pycolmap, request, names[0], steps, say)
        lens = steps.result("lens") or {}
        if steps.result("extended") is None:
            _extend(pycolmap, request, steps, say)
        names = ["extended", *names[1:]]
    shutil.rmtree(request["output"], ignore_errors=True)
    models = [
        _write(pycolmap, steps.read(pycolmap, name), Path(request["output"]) / str(i)) for i, name in enumerate(names)
    ]
    return {"models": models, "lens": lens}


def _options(pycolmap: Any, request: dict[str, Any]) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = _threads(request)
    options.image_path = request["images"]
    options.min_model_size = SMALLEST_MODEL
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = request["seed"]
    return options


def _threads(request: dict[str, Any]) -> int:
    return 1 if len(request["in_order"]) <= REPEATABLE else int(request["threads"])


def _first_models(pycolmap: Any, request: dict[str, Any], steps: Steps, say: Say) -> list[str]:
    """Return the names of the models of the first attempt that places enough images, largest first."""
    total = len(request["in_order"])
    say(phase="cameras", total=total)
    names, most = [], 0
    attempts = (AT_ONCE,) if request["mapper"] == "global" else tuple(ATTEMPTS)
    for attempt in attempts:
        if (sizes := steps.result(f"tried {attempt}")) is None:
            sizes = _attempt(pycolmap, request, steps, say, attempt)
            steps.finish(f"tried {attempt}", sizes)
        if (placed := max(sizes.values(), default=0)) > CLEARLY * most:
            if attempt != attempts[0]:
                say(note=f"cameras were placed {attempt}: {placed} photographs, {most} with stricter thresholds")
            names, most = list(sizes), placed
        if most >= ENOUGH * total:
            break
    return names


def _attempt(pycolmap: Any, request: dict[str, Any], steps: Steps, say: Say, attempt: str) -> dict[str, int]:
    """Map once; returns the image count of each usable model by name, largest first."""
    total, placed = len(request["in_order"]), 0

    def on_placed(number: int) -> None:
        nonlocal placed
        placed += number
        say(done=min(placed, total))

    say(done=0)
    if attempt == AT_ONCE:
        names = map_globally(pycolmap, request, steps, attempt, threads=_threads(request))
    else:
        options = _options(pycolmap, request)
        for threshold, value in ATTEMPTS[attempt].items():
            setattr(options.mapper, threshold, value)
        names = map_incrementally(pycolmap, request["database"], options, steps, attempt, on_placed)
    models = {each: steps.read(pycolmap, each) for each in names}
    sizes = {
        each: (model.num_reg_images(), model.num_points3D())
        for each, model in models.items()
        if model.num_reg_images() >= SMALLEST_MODEL and model.num_points3D()
    }
    return {each: sizes[each][0] for each in sorted(sizes, key=lambda each: sizes[each], reverse=True)}


def _settle_lens(pycolmap: Any, request: dict[str, Any], name: str, steps: Steps, say: Say) -> None:
    """Step "lens": write the model ``name`` with its final lens: as requested, or by the number of images."""
    model, chosen = steps.read(pycolmap, name), request["asked_lens"]
    if not chosen:
        say(phase="lenses", total=0)
        model = with_rich_lenses(pycolmap, model, threads=_threads(request))
        chosen = max((camera.model.name for camera in model.cameras.values()), key=[PANORAMA, START, RICH].index)
    steps.write("lens", model)
    steps.finish("lens", {"chosen": chosen, "asked": request["asked_lens"]})


def _extend(pycolmap: Any, request: dict[str, Any], steps: Steps, say: Say) -> None:
    """Step "extended": place images that did not fit before the lens was chosen."""
    model = steps.read(pycolmap, "lens")
    placed, total = model.num_reg_images(), len(request["in_order"])
    if placed < total:
        say(phase="extending", total=total - placed)
        options, count = _options(pycolmap, request), 0

        def on_placed(number: int) -> None:
            nonlocal count
            count += number
            say(done=min(count, total - placed))

        larger = extend(pycolmap, request["database"], options, steps, "lens", on_placed)
        model = larger if larger is not None and larger.num_reg_images() > placed else model
    steps.write("extended", model)
    steps.finish("extended", True)


def _write(pycolmap: Any, model: Any, folder: Path) -> dict[str, Any]:
    """Rotate a model so that +z is up, and write it; returns its statistics."""
    images = [image for _, image in sorted(model.images.items()) if image.has_pose]
    up = up_direction(np.stack([image.cam_from_world().rotation.matrix() for image in images]))
    if up is not None:
        rotation = pycolmap.Rotation3d(rotation_to_z(up))
        model.transform(pycolmap.Sim3d(1.0, rotation, np.zeros(3)))
    folder.mkdir(parents=True)
    model.write(str(folder))
    return {
        "upright": up is not None,
        "mean_error": float(model.compute_mean_reprojection_error()),
        "mean_track": float(model.compute_mean_track_length()),
    }


def _messages() -> Say:
    """Return a function that sends a message to the parent. Output of native code is redirected to stderr."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def say(**message: Any) -> None:
        channel.write(json.dumps(message) + "\n")
        channel.flush()

    return say


def _end_with_parent() -> None:
    """End this process when stdin is closed, which happens when the parent ends."""
    while os.read(0, 4096):
        continue
    os._exit(1)


if __name__ == "__main__":
    main(sys.argv[1])
