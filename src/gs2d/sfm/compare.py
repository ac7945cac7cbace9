"""Find features and match image pairs with COLMAP. Both continue where an interrupted search ended.

COLMAP writes each image and each pair in a separate transaction, and skips those that are in the database.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.atomic_files import atomic_write
from gs2d.sfm.pairs import Chosen, chosen, near_pairs, neighbour_pairs, similar_pairs
from gs2d.sfm.panoramas import FINER, PANORAMA

Say = Callable[..., None]
ALIKE = "alike.json"  # beside the database: pairs of similar images
LESS_NEXT, LESS_ALIKE = 3, 4  # divisors for consecutive and similar images if positions are known (notebook/sfm.md)


def find_features(pycolmap: Any, request: dict[str, Any], say: Say) -> None:
    """Write SIFT features of all images to the database. Each group of images shares a camera.

    The images are registered first, so that their ids do not depend on the order of threads.
    """
    say(phase="features", total=len(request["in_order"]))
    database, images = request["database"], request["images"]
    if _count_images(database) != len(request["in_order"]):  # new, or interrupted while images were registered
        _register(pycolmap, request)
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = request["threads"]
    mode, reader = pycolmap.CameraMode.AUTO, pycolmap.ImageReaderOptions()
    if request.get("masks"):
        reader.mask_path = request["masks"]
    for finer in (1, FINER):
        options.max_image_size = finer * request["feature_size"]
        groups = [group for group in request["groups"] if (group["camera_model"] == PANORAMA) is (finer == FINER)]
        if names := [name for group in groups for name in group["names"]]:
            pycolmap.extract_features(database, images, names, mode, reader, options, pycolmap.Device.cpu)


def _count_images(database: str) -> int:
    """Count the images in the database; 0 if it does not exist."""
    with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(database, timeout=60.0)) as connection:
        return int(connection.execute("SELECT COUNT(*) FROM images").fetchone()[0])
    return 0


def _register(pycolmap: Any, request: dict[str, Any]) -> None:
    """Write images and cameras to a new database."""
    for path in Path(request["database"]).parent.glob(f"{Path(request['database']).name}*"):
        path.unlink()
    pycolmap.Database.open(request["database"]).close()
    for group in request["groups"]:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = group["camera_model"]
        reader.camera_params = _prior(pycolmap, group)
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(request["database"], request["images"], mode, group["names"], reader)


def _prior(pycolmap: Any, group: dict[str, Any]) -> str:
    """Return camera parameters from the EXIF of the group's first original; empty without a focal length.

    The original is read because COLMAP interprets some tags in pixels, and a copy may be smaller. The parameters of a
    panorama are its size.
    """
    if group["camera_model"] == PANORAMA:
        return ", ".join(map(str, group["size"]))
    try:
        original = pycolmap.infer_camera_from_image(group["original"])
    except (RuntimeError, ValueError):  # a format that COLMAP cannot read; the copy has been converted
        return ""
    if not original.has_prior_focal_length:
        return ""
    width, height = group["size"]
    f = original.mean_focal_length() * max(width, height) / max(original.width, original.height)
    camera = pycolmap.Camera.create_from_model_name(1, group["camera_model"], f, width, height)
    return ", ".join(repr(float(value)) for value in camera.params)


def match(pycolmap: Any, request: dict[str, Any], say: Say) -> None:
    """Match image pairs and verify the matches with a fundamental or essential matrix."""
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
    """Choose the pairs to match if not all are matched: consecutive, spatially near, and similar images."""
    matching, count = request["matching"], len(request["in_order"])
    next_to = f"next to each other by {request['ordered_by']}"
    following = neighbour_pairs(count, request["overlap"])
    reasons = {next_to: following}
    if matching == "spatial":
        reasons = {"near in space": near_pairs(request["places"], request["neighbours"] // 2)}
        lost = {i for i, place in enumerate(request["places"]) if place is None}
        few = request["overlap"] // LESS_NEXT
        reasons[next_to] = {(i, j) for i, j in following if j - i <= few or lost & {i, j}}
    if matching != "sequential":
        say(phase="comparing", total=2 * count)
        reasons["similar"] = _similar(pycolmap, request, say)
    return chosen(reasons)


def _alike(request: dict[str, Any]) -> list[int]:
    """Return the number of similar images to match each image with: fewer if its position is known."""
    many = int(request["neighbours"])
    if request["matching"] != "spatial":
        return [many] * len(request["in_order"])
    return [many if place is None else many // LESS_ALIKE for place in request["places"]]


def _similar(pycolmap: Any, request: dict[str, Any], say: Say) -> set[tuple[int, int]]:
    """Return pairs of similar images; kept in a file for an interrupted search."""
    kept = Path(request["database"]).with_name(ALIKE)
    if kept.exists():
        return {(i, j) for i, j in json.loads(kept.read_text(encoding="utf-8"))}
    database = pycolmap.Database.open(request["database"])
    try:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        names, done = request["in_order"], itertools.count(1)

        def read(i: int) -> np.ndarray:
            say(done=next(done))
            return np.asarray(database.read_descriptors(ids[names[i]]).data).reshape(-1, 128)

        pairs = similar_pairs(read, len(names), neighbours=_alike(request), seed=request["seed"])
    finally:
        database.close()
    with atomic_write(kept, "w") as file:
        json.dump(sorted(pairs), file)
    return pairs
