"""The process in which COLMAP runs: ``python -m gs2d.sfm.colmap_worker REQUEST.json``. It never loads torch.

A process of its own, because a fault in a native library must not take the command down, because Ctrl-C must not wait
for a native call that takes minutes, and because torch and pycolmap each bring an OpenMP library. It writes one JSON
object a line to stdout and ends when its stdin does: when its parent is gone, however that ended.
"""

from __future__ import annotations

import itertools
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
from gs2d.sfm import as_fisheye
from gs2d.sfm import second_round as second
from gs2d.sfm.assemble import merged, mount
from gs2d.sfm.compare import find_features, likeness, match
from gs2d.sfm.grow import grow_all, grow_on
from gs2d.sfm.lens import (
    BENT,
    START,
    adjust,
    apply,
    choose,
    doubts,
    drop_outliers,
    is_tied,
    models_to_try,
    try_lenses,
)
from gs2d.sfm.panoramas import PANORAMA
from gs2d.sfm.place_all import place_all
from gs2d.sfm.search import HINTED, MAPPING
from gs2d.sfm.steps import Steps
from gs2d.sfm.upright import up_direction

Say = Callable[..., None]
REPEATABLE = 50  # photographs: up to so many, one thread places them, and the same seed gives the same bytes
SMALLEST_MODEL = 3  # photographs: smaller pieces are nothing that could be trained
# Ways of placing cameras one by one, each where the one before placed too few, and what they ask of the first two:
# COLMAP wants 16 degrees between them (4 when relaxed), and not one before the other, as they are on a walk (4, and 1).
ATTEMPTS: dict[str, dict[str, float]] = {
    "strictly": {},
    "as on a walk": {"init_max_forward_motion": 1.0, "init_min_tri_angle": 4.0},
}
AT_ONCE = "all at once"  # the global mapper, which also places a camera that only turned
ENOUGH = 0.5  # of the photographs in one model: no other way is tried
CLEARLY = 1.5  # times as many photographs must an easier way place, or the stricter one is believed
AS_FISHEYES = "as fisheyes, "  # before the name of a way: cameras that were first placed as other lenses
FISHEYES = "fisheyes"  # step: what was found of the cameras that were looked at


def main(request_path: str) -> None:
    """Find features, match, map; then the models, the largest first, in ``output/0``, ``output/1`` ..."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    say = _messages()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    request = json.loads(Path(request_path).read_text(encoding="utf-8"))
    import pycolmap

    pycolmap.logging.logtostderr = True  # and not into files of its own in the folder for temporary files
    pycolmap.logging.minloglevel = int(pycolmap.logging.WARNING)
    pycolmap.set_random_seed(request["seed"])
    steps = Steps(Path(request["database"]).with_name(MAPPING))
    if steps.facts("first") is None:  # else cameras are placed already, and the second round may compare pairs anew
        find_features(pycolmap, request, say)
        match(pycolmap, request, say)
    say(**map_(pycolmap, request, steps, say))


def map_(pycolmap: Any, request: dict[str, Any], steps: Steps, say: Say) -> dict[str, Any]:
    """Cameras and points from the matches; every connected piece becomes a model, upright where it can be.

    Each step begins with what the one before wrote, and is not done again after an interruption.

    Returns
    -------
    dict
        ``models``: what was done to each, the largest first; ``lens``: what was decided about it; ``refused``: the
        reason for each photograph that the second round placed and took out again.
    """
    if steps.facts(HINTED) is None:
        as_fisheye.settle_hinted(pycolmap, request, steps, say)
    if steps.facts("first") is None:
        _first_round(pycolmap, request, steps, say)
    if steps.facts("joined") is None:
        _join_pieces(pycolmap, request, steps, say)
    pieces = [steps.read(pycolmap, name) for name in steps.facts("joined") or ()]
    lens: dict[str, Any] = {}
    refused: dict[str, str] = {}
    if pieces:
        if steps.facts("lens") is None:
            _settle_lens(pycolmap, request, pieces[0], steps, say)
        lens = steps.facts("lens") or {}
        if steps.facts("second") is None:
            _second_round(pycolmap, request, lens, steps, say)
        pieces[0], refused = steps.read(pycolmap, "second"), steps.facts("second") or {}
        placed = _names(pieces[0])
        pieces[1:] = [piece for piece in pieces[1:] if not _names(piece) <= placed]
    shutil.rmtree(request["output"], ignore_errors=True)
    models = [_write(pycolmap, piece, Path(request["output"]) / str(i)) for i, piece in enumerate(pieces)]
    return {"models": models, "lens": lens, "refused": refused}


def _options(pycolmap: Any, request: dict[str, Any]) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = _threads(request)
    options.image_path = request["images"]
    options.min_model_size = SMALLEST_MODEL
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = request["seed"]
    return options


def _threads(request: dict[str, Any]) -> int:
    return 1 if len(request["in_order"]) <= REPEATABLE else int(request["threads"])


def _names(piece: Any) -> set[str]:
    return {image.name for image in piece.images.values() if image.has_pose}


def _first_round(pycolmap: Any, request: dict[str, Any], steps: Steps, say: Say) -> None:
    """Models from nothing: step "first" names them, the largest first.

    Where they leave a doubt whether a camera is a fisheye, and its photographs tell of one, they are made once more.
    """
    names, _ = _tried(pycolmap, request, steps, say, "")
    looked_at = steps.facts(HINTED) or []
    if (found := steps.facts(as_fisheye.SUSPECTED)) is None:
        found = as_fisheye.suspects(pycolmap, request, steps.read(pycolmap, names[0]) if names else None)
        steps.finish(as_fisheye.SUSPECTED, found)
    if found:
        names, found = _as_fisheyes(pycolmap, request, steps, say, names, found)
    steps.finish(FISHEYES, [*looked_at, *found])
    steps.finish("first", names)


def _tried(pycolmap: Any, request: dict[str, Any], steps: Steps, say: Say, before: str) -> tuple[list[str], int]:
    """Return the models of the first way that places enough, and how many photographs the largest of them has.

    Where COLMAP's own demands on the first two cameras leave most photographs without a place, easier ones are tried.
    """
    total = len(request["in_order"])
    say(phase="cameras", total=total)
    names, most = [], 0
    attempts = (AT_ONCE,) if request["mapper"] == "global" else tuple(ATTEMPTS)
    for attempt in attempts:
        if (sizes := steps.facts(f"tried {before}{attempt}")) is None:
            sizes = _attempt(pycolmap, request, steps, say, attempt, f"{before}{attempt}")
            steps.finish(f"tried {before}{attempt}", sizes)
        if (placed := max(sizes.values(), default=0)) > CLEARLY * most:
            if attempt != attempts[0]:
                say(note=f"cameras were placed {attempt}: {placed} photographs, {most} by stricter rules")
            names, most = list(sizes), placed
        if most >= ENOUGH * total:
            break
    return names, most


def _as_fisheyes(
    pycolmap: Any, request: dict[str, Any], steps: Steps, say: Say, names: list[str], found: list[dict[str, Any]]
) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the models with cameras as fisheyes, and what was found of these; those of before, if better."""
    before = steps.facts("as they were")
    if before is None:
        cameras = as_fisheye.cameras_of(pycolmap, request, [row["camera"] for row in found])
        before = [[camera.model.name, list(camera.params), camera.has_prior_focal_length] for camera in cameras]
        steps.finish("as they were", before)
    if steps.facts(as_fisheye.VERIFIED) is None:
        as_fisheye.verify_anew(pycolmap, request, steps, as_fisheye.fisheyes(pycolmap, request, found), say)
        steps.finish(as_fisheye.VERIFIED, True)
    theirs, _ = _tried(pycolmap, request, steps, say, AS_FISHEYES)
    largest = steps.read(pycolmap, theirs[0]) if theirs else None
    if largest is not None and as_fisheye.is_better(largest, steps.read(pycolmap, names[0]) if names else None):
        return theirs, found
    as_fisheye.put_back(pycolmap, request, steps, found, before, say)
    return names, [{**row, "params": None} for row in found]


def _attempt(pycolmap: Any, request: dict[str, Any], steps: Steps, say: Say, attempt: str, name: str) -> dict[str, int]:
    """Return how many photographs each model has that one way of placing cameras makes, by name, the largest first."""
    total, placed = len(request["in_order"]), 0

    def count(more: int) -> None:
        nonlocal placed
        placed += more
        say(done=min(placed, total))

    say(done=0)
    if attempt == AT_ONCE:
        place_all(pycolmap, request, steps, name, threads=_threads(request))
    else:
        options, often = _options(pycolmap, request), total > REPEATABLE
        for demand, value in ATTEMPTS[attempt].items():
            setattr(options.mapper, demand, value)
        grow_all(pycolmap, request["database"], options, steps, name, count, often=often)
    found = [f"{name}-{i}" for i in itertools.takewhile(lambda i: steps.has(f"{name}-{i}"), itertools.count())]
    pieces = {each: steps.read(pycolmap, each) for each in found}
    sizes = {
        each: (piece.num_reg_images(), piece.num_points3D())
        for each, piece in pieces.items()
        if piece.num_reg_images() >= SMALLEST_MODEL and piece.num_points3D()
    }
    return {each: sizes[each][0] for each in sorted(sizes, key=lambda each: sizes[each], reverse=True)}


def _join_pieces(pycolmap: Any, request: dict[str, Any], steps: Steps, say: Say) -> None:
    """Step "joined": names of the models, after those that share photographs became one, and cameras of a rig too."""
    names = steps.facts("first") or []
    options, threads = _options(pycolmap, request), _threads(request)
    if len(names) > 1:
        grown = [steps.read(pycolmap, name) for name in names]
        pieces, joined = merged(pycolmap, request, options, grown, threads=threads)
        for larger, smaller in joined:
            say(note=f"two pieces that share photographs became one: {larger} and {smaller} photographs")
        if joined:
            names = _write_pieces(steps, "piece", pieces)
    if request["rig"] and names:
        pieces = [steps.read(pycolmap, name) for name in names]
        mounted = mount(pycolmap, request, options, pieces[0], threads=threads)
        names = _write_pieces(steps, "mounted", [mounted]) + names[1:]
    steps.finish("joined", names)


def _write_pieces(steps: Steps, name: str, pieces: list[Any]) -> list[str]:
    for i, piece in enumerate(pieces):
        steps.write(f"{name}-{i}", piece)
    return [f"{name}-{i}" for i in range(len(pieces))]


def _settle_lens(pycolmap: Any, request: dict[str, Any], piece: Any, steps: Steps, say: Say) -> None:
    """Step "lens": the model with the lens that is best, and what was decided."""
    facts = {**_lens_of(pycolmap, request, piece, say), "fisheyes": steps.facts(FISHEYES) or []}
    steps.write("lens", piece)
    steps.finish("lens", facts)


def _lens_of(pycolmap: Any, request: dict[str, Any], piece: Any, say: Say) -> dict[str, Any]:
    """Compare lenses where none was asked for, or where the one that was is doubtful; the best is in the model then."""
    asked = request["asked_lens"]
    if all(camera.model.name == PANORAMA for camera in piece.cameras.values()):
        return {"chosen": PANORAMA, "asked": asked, "trials": []}
    if asked == "OPENCV_FISHEYE" or (asked and not any(map(doubts, piece.cameras.values()))):
        return {"chosen": asked, "asked": asked, "trials": []}
    say(phase="lenses", total=len(models_to_try(asked)))
    trials = try_lenses(
        pycolmap, piece, asked=asked, seed=request["seed"], threads=_threads(request), on_done=lambda i: say(done=i)
    )
    if asked:  # it is what the user wants; that it is doubted is said
        chosen = asked
    else:
        best = choose(trials)
        chosen = best.model
        if chosen not in (START, BENT[START]):
            apply(pycolmap, piece, best, threads=_threads(request))
    return {
        "chosen": chosen,
        "asked": asked,
        "trials": [{"model": t.model, "error_px": t.error, "doubts": list(t.doubts)} for t in trials],
    }


def _second_round(pycolmap: Any, request: dict[str, Any], lens: dict[str, Any], steps: Steps, say: Say) -> None:
    """Step "second": the model with photographs that only less strict rules place; why others were taken out again."""
    piece = steps.read(pycolmap, "lens")
    larger, refused = _second_chance(pycolmap, request, piece, lens, steps, say)
    steps.write("second", larger)
    steps.finish("second", refused)


def _second_chance(
    pycolmap: Any, request: dict[str, Any], piece: Any, lens: dict[str, Any], steps: Steps, say: Say
) -> tuple[Any, dict[str, str]]:
    names, placed = request["in_order"], _names(piece)
    lost = [name for name in names if name not in placed]
    if not lost:
        return piece, {}
    if (pairs := steps.facts("pairs again")) is None:
        pairs = sorted(second.partners(lost, names, placed, likeness(pycolmap, request)))
        steps.finish("pairs again", pairs)
    if not pairs:
        return piece, {}
    if steps.facts("forgotten") is None:
        second.forget(pycolmap, request, pairs, piece.cameras)
        steps.finish("forgotten", True)
    if steps.facts("matched again") is None:
        already = second.known(pycolmap, request, pairs)
        say(phase="again", total=len(pairs), done=already)
        second.match_again(pycolmap, request, pairs)
        steps.finish("matched again", True)
    say(phase="cameras again", total=len(lost))
    options = second.relax(_options(pycolmap, request))
    if is_tied(lens["chosen"]) and not lens["asked"]:  # one focal length for both axes
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    more = -len(placed)

    def count(number: int) -> None:
        nonlocal more
        more += number
        say(done=max(0, min(more, len(lost))))

    often = len(names) > REPEATABLE
    larger = grow_on(pycolmap, request["database"], options, steps, "lens", count, often=often)
    if larger is None or not _names(larger) > placed:  # nothing was won, or something lost
        return piece, {}
    refused = second.refuse_unsupported(larger, _names(larger) - placed)
    if _names(larger) == placed:  # none was right: the model of before has not been bent by them
        return piece, refused
    if refused:
        adjust(pycolmap, larger, tied=not options.ba_refine_focal_length, threads=_threads(request))
        drop_outliers(pycolmap, larger)
    return larger, refused


def _write(pycolmap: Any, piece: Any, folder: Path) -> dict[str, Any]:
    """Turn a model upright and write it; what was done to it."""
    images = [image for _, image in sorted(piece.images.items()) if image.has_pose]
    up = up_direction(np.stack([image.cam_from_world().rotation.matrix() for image in images]))
    if up is not None:
        rotation = pycolmap.Rotation3d(rotation_to_z(up))
        piece.transform(pycolmap.Sim3d(1.0, rotation, np.zeros(3)))
    folder.mkdir(parents=True)
    piece.write(str(folder))
    return {
        "upright": up is not None,
        "mean_error": float(piece.compute_mean_reprojection_error()),
        "mean_track": float(piece.compute_mean_track_length()),
    }


def _messages() -> Say:
    """Return a function that sends a message to the parent; what native code prints goes to stderr instead."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def say(**message: Any) -> None:
        channel.write(json.dumps(message) + "\n")
        channel.flush()

    return say


def _end_with_parent() -> None:
    """Nobody writes to stdin: it ends when the process that holds its other end does."""
    while os.read(0, 4096):
        continue
    os._exit(1)


if __name__ == "__main__":
    main(sys.argv[1])
