"""The process in which COLMAP runs: ``python -m gs2d.sfm.colmap_worker REQUEST.json``. It never loads torch.

A process of its own, because a fault in a native library must not take the command down, because Ctrl-C must not wait
for a native call that takes minutes, and because torch and pycolmap each bring an OpenMP library. It writes one JSON
object a line to stdout and ends when its stdin does: when its parent is gone, however that ended.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.similarity import rotation_to_z
from gs2d.sfm import second_round as second
from gs2d.sfm.lens import START, adjust, apply, choose, doubts, drop_outliers, models_to_try, try_lenses
from gs2d.sfm.pairs import Chosen, chosen, near_pairs, neighbour_pairs, similar_pairs
from gs2d.sfm.upright import up_direction

Say = Callable[..., None]
REPEATABLE = 50  # photographs: up to so many, one thread places them, and the same seed gives the same bytes
SMALLEST_MODEL = 3  # photographs: smaller pieces are nothing that could be trained


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
    find_features(pycolmap, request, say)
    match(pycolmap, request, say)
    say(**map_(pycolmap, request, say))


def find_features(pycolmap: Any, request: dict[str, Any], say: Say) -> None:
    """SIFT features of all photographs into the database; each group of photographs shares a camera.

    The photographs are listed before, so that their numbers do not depend on which thread is first.
    """
    say(phase="features", total=len(request["in_order"]))
    database, images = request["database"], request["images"]
    pycolmap.Database.open(database).close()
    for group in request["groups"]:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = group["camera_model"]
        reader.camera_params = _prior(pycolmap, group)
        pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE, group["names"], reader)
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = request["threads"]
    options.max_image_size = request["feature_size"]
    mode, reader = pycolmap.CameraMode.AUTO, pycolmap.ImageReaderOptions()
    names = [name for group in request["groups"] for name in group["names"]]
    pycolmap.extract_features(database, images, names, mode, reader, options, pycolmap.Device.cpu)


def _prior(pycolmap: Any, group: dict[str, Any]) -> str:
    """Camera parameters from the EXIF block of the group's first original; empty without a focal length in it.

    Of the original, because COLMAP takes some of the tags as pixels, which a smaller copy has fewer of.
    """
    try:
        original = pycolmap.infer_camera_from_image(group["original"])
    except (RuntimeError, ValueError):  # a format that COLMAP does not read; the copy is one that it does
        return ""
    if not original.has_prior_focal_length:
        return ""
    width, height = group["size"]
    f = original.mean_focal_length() * max(width, height) / max(original.width, original.height)
    camera = pycolmap.Camera.create_from_model_name(1, group["camera_model"], f, width, height)
    return ", ".join(repr(float(value)) for value in camera.params)


def match(pycolmap: Any, request: dict[str, Any], say: Say) -> None:
    """Compare photographs and verify what matches by a fundamental or essential matrix."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = request["threads"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = request["seed"]
    database, cpu = request["database"], pycolmap.Device.cpu
    names = request["in_order"]
    if request["matching"] == "exhaustive":
        say(phase="matching", total=len(names) * (len(names) - 1) // 2)
        pairing = pycolmap.ExhaustivePairingOptions()
        pycolmap.match_exhaustive(database, matching, pairing, verification, cpu)
        return
    pairs = _pairs(pycolmap, request, say)
    say(phase="matching", total=len(pairs), note=pairs.line(len(names)))
    listed = Path(database).with_name("pairs.txt")
    listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs.pairs), encoding="utf-8")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    pycolmap.match_image_pairs(database, matching, pairing, verification, cpu)


def _pairs(pycolmap: Any, request: dict[str, Any], say: Say) -> Chosen:
    """Which pairs to compare, where not all are: next ones, those near in space, and those that look alike."""
    matching, count = request["matching"], len(request["in_order"])
    next_to = f"next to each other by {request['ordered_by']}"
    reasons = {next_to: neighbour_pairs(count, request["overlap"])}
    others = request["neighbours"]
    if matching == "spatial":
        reasons["near in space"] = near_pairs(request["places"], others - others // 2)
        others //= 2
    if matching != "sequential" and others:
        say(phase="comparing", total=2 * count)
        reasons["that look alike"] = _similar(pycolmap, request, others, say)
    return chosen(reasons)


def _similar(pycolmap: Any, request: dict[str, Any], neighbours: int, say: Say) -> set[tuple[int, int]]:
    database = pycolmap.Database.open(request["database"])
    try:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        names, done = request["in_order"], itertools.count(1)

        def read(i: int) -> np.ndarray:
            say(done=next(done))
            return np.asarray(database.read_descriptors(ids[names[i]]).data).reshape(-1, 128)

        return similar_pairs(read, len(names), neighbours=neighbours, seed=request["seed"])
    finally:
        database.close()


def map_(pycolmap: Any, request: dict[str, Any], say: Say) -> dict[str, Any]:
    """Cameras and points from the matches; every connected piece becomes a model, upright where it can be.

    Returns
    -------
    dict
        ``models``: what was done to each, the largest first; ``lens``: what was decided about it; ``refused``: the
        reason for each photograph that the second round placed and took out again.
    """
    pieces = _first_round(pycolmap, request, say)
    lens: dict[str, Any] = {}
    refused: dict[str, str] = {}
    if pieces:
        lens = _settle_lens(pycolmap, request, pieces[0], say)
        pieces[0], refused = _second_round(pycolmap, request, pieces[0], lens, say)
        placed = _names(pieces[0])
        pieces[1:] = [piece for piece in pieces[1:] if not _names(piece) <= placed]
    models = [_write(pycolmap, piece, Path(request["output"]) / str(i)) for i, piece in enumerate(pieces)]
    return {"models": models, "lens": lens, "refused": refused}


def _options(pycolmap: Any, request: dict[str, Any]) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = _threads(request)
    options.min_model_size = SMALLEST_MODEL
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = request["seed"]
    return options


def _threads(request: dict[str, Any]) -> int:
    return 1 if len(request["in_order"]) <= REPEATABLE else int(request["threads"])


def _names(piece: Any) -> set[str]:
    return {image.name for image in piece.images.values() if image.has_pose}


def _first_round(pycolmap: Any, request: dict[str, Any], say: Say) -> list[Any]:
    """Models from nothing, the largest first."""
    total = len(request["in_order"])
    say(phase="cameras", total=total)
    placed = 0

    def count(more: int) -> Callable[[], None]:
        def add() -> None:
            nonlocal placed
            placed += more
            say(done=min(placed, total))

        return add

    work = Path(request["database"]).with_name("pieces")
    work.mkdir()
    found = pycolmap.incremental_mapping(
        request["database"], request["images"], str(work), _options(pycolmap, request), "", count(2), count(1)
    )
    pieces = sorted(found.values(), key=lambda piece: (-piece.num_reg_images(), -piece.num_points3D()))
    return [piece for piece in pieces if piece.num_reg_images() >= SMALLEST_MODEL and piece.num_points3D()]


def _settle_lens(pycolmap: Any, request: dict[str, Any], piece: Any, say: Say) -> dict[str, Any]:
    """Compare lenses where none was asked for, or where the one that was is doubtful; the best is in the model then."""
    asked = request["asked_lens"]
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
        if chosen != START:
            apply(pycolmap, piece, best, threads=_threads(request))
    return {
        "chosen": chosen,
        "asked": asked,
        "trials": [{"model": t.model, "error_px": t.error, "doubts": list(t.doubts)} for t in trials],
    }


def _second_round(
    pycolmap: Any, request: dict[str, Any], piece: Any, lens: dict[str, Any], say: Say
) -> tuple[Any, dict[str, str]]:
    """Return the model with photographs that only less strict rules place, and why others were taken out again."""
    names, placed = request["in_order"], _names(piece)
    lost = [name for name in names if name not in placed]
    if not lost:
        return piece, {}
    pairs = sorted(second.partners(lost, names, placed, _likeness(pycolmap, request, names)))
    if not pairs:
        return piece, {}
    second.match_again(pycolmap, request, pairs, piece.cameras, lambda: say(phase="again", total=len(pairs)))
    say(phase="cameras again", total=len(lost))
    found = itertools.count(1)
    options = second.relax(_options(pycolmap, request))
    if lens["chosen"] == "OPENCV" and not lens["asked"]:  # one focal length for both axes
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    start, work = (Path(request["database"]).with_name(name) for name in ("first", "again"))
    for folder in (start, work):
        folder.mkdir()
    piece.write(str(start))
    database, images = request["database"], request["images"]
    count = lambda: say(done=min(next(found), len(lost)))  # noqa: E731 - a callback without arguments
    models = pycolmap.incremental_mapping(database, images, str(work), options, str(start), lambda: None, count)
    larger = max(models.values(), key=lambda model: int(model.num_reg_images()), default=piece)
    if not _names(larger) > placed:  # nothing was won, or something lost
        return piece, {}
    refused = second.refuse_unsupported(larger, _names(larger) - placed)
    if _names(larger) == placed:  # none was right: the model of before has not been bent by them
        return piece, refused
    if refused:
        adjust(pycolmap, larger, tied=not options.ba_refine_focal_length, threads=_threads(request))
        drop_outliers(pycolmap, larger)
    return larger, refused


def _likeness(pycolmap: Any, request: dict[str, Any], names: list[str]) -> Callable[[str, str], float]:
    """How much two photographs share: verified matches, and where they were not compared, how alike they look."""
    if request["matching"] != "exhaustive":
        near = {
            frozenset((names[i], names[j]))
            for i, j in _similar(pycolmap, request, request["neighbours"], lambda **_: None)
        }
    else:
        near = set()
    database = pycolmap.Database.open(request["database"])
    try:
        name = {image.image_id: image.name for image in database.read_all_images()}
        pairs, counts = database.read_two_view_geometry_num_inliers()
        shared = {
            frozenset(name[i] for i in pycolmap.pair_id_to_image_pair(pair)): float(count)
            for pair, count in zip(pairs, counts, strict=True)
        }
    finally:
        database.close()
    return lambda a, b: shared.get(frozenset((a, b)), 0.0) + 0.5 * (frozenset((a, b)) in near)


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
