"""The process in which COLMAP runs: ``python -m gs2d.sfm.worker REQUEST.json``. It never loads torch.

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

from gs2d.sfm.similar import neighbour_pairs, similar_pairs
from gs2d.sfm.upright import rotation_to_z, up_direction

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
    say(models=map_(pycolmap, request, say))


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
    pairs = neighbour_pairs(len(names), request["overlap"])
    if request["matching"] == "similar":
        say(phase="comparing", total=2 * len(names))
        pairs |= _similar(pycolmap, request, say)
    say(phase="matching", total=len(pairs))
    listed = Path(database).with_name("pairs.txt")
    listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in sorted(pairs)), encoding="utf-8")
    chosen = pycolmap.ImportedPairingOptions()
    chosen.match_list_path = str(listed)
    pycolmap.match_image_pairs(database, matching, chosen, verification, cpu)


def _similar(pycolmap: Any, request: dict[str, Any], say: Say) -> set[tuple[int, int]]:
    database = pycolmap.Database.open(request["database"])
    try:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        names, done = request["in_order"], itertools.count(1)

        def read(i: int) -> np.ndarray:
            say(done=next(done))
            return np.asarray(database.read_descriptors(ids[names[i]]).data).reshape(-1, 128)

        return similar_pairs(read, len(names), neighbours=request["neighbours"], seed=request["seed"])
    finally:
        database.close()


def map_(pycolmap: Any, request: dict[str, Any], say: Say) -> list[dict[str, Any]]:
    """Cameras and points from the matches; every connected piece becomes a model, upright where it can be."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1 if len(request["in_order"]) <= REPEATABLE else request["threads"]
    options.min_model_size = SMALLEST_MODEL
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = request["seed"]
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
        request["database"], request["images"], str(work), options, "", count(2), count(1)
    )
    pieces = sorted(found.values(), key=lambda piece: (-piece.num_reg_images(), -piece.num_points3D()))
    kept = [piece for piece in pieces if piece.num_reg_images() >= SMALLEST_MODEL and piece.num_points3D()]
    return [_write(pycolmap, piece, Path(request["output"]) / str(i)) for i, piece in enumerate(kept)]


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
    """A function that sends a message to the parent; what native code prints goes to stderr instead."""
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
