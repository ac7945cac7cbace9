"""Find features and match image pairs with COLMAP. Both continue where an interrupted search ended.

COLMAP writes each image and each pair in a separate transaction, and skips those that are in the database.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gs2d.core.atomic_files import atomic_write
from gs2d.sfm.lens import FINER, PANORAMA
from gs2d.sfm.search import count, read_only

Say = Callable[..., None]
ALIKE = "alike.json"  # beside the database: pairs of similar images
LESS_NEXT, LESS_ALIKE = 3, 4  # divisors for consecutive and similar images if positions are available (notebook/sfm.md)


def device_of(pycolmap: Any, request: Mapping[str, Any]) -> Any:
    """Return where features are found and matched: on the GPU if this build can, unless that failed before."""
    return pycolmap.Device.cuda if pycolmap.has_cuda and not request.get("on_cpu") else pycolmap.Device.cpu


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
            pycolmap.extract_features(database, images, names, mode, reader, options, device_of(pycolmap, request))


def _count_images(database: str) -> int:
    """Count the images in the database; 0 if it does not exist."""
    with contextlib.suppress(sqlite3.Error), contextlib.closing(read_only(Path(database))) as connection:
        return count(connection, "images")
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
    database, device = request["database"], device_of(pycolmap, request)
    names = request["in_order"]
    if request["matching"] == "exhaustive":
        say(phase="matching", total=len(names) * (len(names) - 1) // 2)
        pairing = pycolmap.ExhaustivePairingOptions()
        pycolmap.match_exhaustive(database, matching, pairing, verification, device)
        return
    reasons = _pairs(pycolmap, request, say)
    pairs = sorted(set().union(*reasons.values()))
    say(phase="matching", total=len(pairs), note=pairs_line(reasons, len(pairs), len(names)))
    listed = Path(database).with_name("pairs.txt")
    listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs), encoding="utf-8")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    pycolmap.match_image_pairs(database, matching, pairing, verification, device)


def _pairs(pycolmap: Any, request: dict[str, Any], say: Say) -> dict[str, set[tuple[int, int]]]:
    """Return the pairs (i < j) to match by reason: consecutive, spatially near, and similar images."""
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
    return reasons


def _alike(request: dict[str, Any]) -> list[int]:
    """Return the number of similar images to match each image with: fewer if it has a position."""
    many = int(request["neighbours"])
    if request["matching"] != "spatial":
        return [many] * len(request["in_order"])
    return [many if place is None else many // LESS_ALIKE for place in request["places"]]


def _similar(pycolmap: Any, request: dict[str, Any], say: Say) -> set[tuple[int, int]]:
    """Return pairs of similar images; stored in a file for an interrupted search."""
    cache = Path(request["database"]).with_name(ALIKE)
    if cache.exists():
        return {(i, j) for i, j in json.loads(cache.read_text(encoding="utf-8"))}
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
    with atomic_write(cache, "w") as file:
        json.dump(sorted(pairs), file)
    return pairs


# -- pairs of images, if all pairs would be too many -------------------------------------------------------------------
WORDS = 64
_ROUNDS = 10  # of k-means
_SAMPLES = 30_000  # descriptors for k-means


def pairs_line(reasons: Mapping[str, set[tuple[int, int]]], pairs: int, count: int) -> str:
    """Summarize how many of all pairs of ``count`` images are matched, and why; a pair may have several reasons."""
    why = ", ".join(f"{len(some):,} {reason}" for reason, some in reasons.items() if some)
    both = " (some for two reasons)" if sum(map(len, reasons.values())) > pairs else ""
    return f"{pairs:,} of {count * (count - 1) // 2:,} pairs of photographs are matched: {why}{both}"


def neighbour_pairs(count: int, overlap: int) -> set[tuple[int, int]]:
    """Return pairs (i < j) of each image with the next ``overlap`` ones, and with those 2^k images later.

    The distant ones (k < overlap) bridge blurred frames, as COLMAP's quadratic overlap does.
    """
    steps = {*range(1, overlap + 1), *(1 << k for k in range(overlap))}
    return {(i, i + step) for i in range(count) for step in steps if i + step < count}


def near_pairs(positions: Sequence[Sequence[float] | None], neighbours: int) -> set[tuple[int, int]]:
    """Return pairs (i < j) of each image with the spatially nearest ones.

    ``positions`` [3]: metres; None if unknown. ``neighbours``: number of nearest images to pair each image with.
    """
    located = [i for i, position in enumerate(positions) if position is not None]
    if len(located) < 2:
        return set()
    at = np.array([positions[i] for i in located], dtype=float)
    count = min(neighbours, len(located) - 1)
    _, nearest = cKDTree(at).query(at, k=count + 1)
    pairs = set()
    for row, others in enumerate(np.atleast_2d(nearest)):  # with equal positions, the image itself need not be first
        for other in [j for j in others if j != row][:count]:
            pairs.add((located[min(row, other)], located[max(row, other)]))
    return pairs


def similar_pairs(
    read: Callable[[int], np.ndarray], count: int, *, neighbours: int | Sequence[int], seed: int = 0
) -> set[tuple[int, int]]:
    """Return pairs (i < j) of each image with the most similar ones.

    Each image becomes one vector: sums of the residuals of its SIFT descriptors to ``WORDS`` cluster centres,
    normalised per centre and as a whole (VLAD with intra-normalisation: Jegou et al. 2010, Arandjelovic and
    Zisserman 2013). The cluster centres are computed from the images, so nothing is downloaded.

    ``read``: returns the descriptors [M, 128] of an image; called twice for each. ``neighbours``: number of similar
    images to pair each image with, for all or for each.
    """
    each_of = [neighbours] * count if isinstance(neighbours, int) else neighbours
    rng = np.random.default_rng(seed)
    each = max(1, _SAMPLES // max(count, 1))
    chosen = [_sample(read(i), each, rng) for i in range(count)]
    samples = np.concatenate(chosen) if chosen else np.empty((0, 128), np.float32)
    if len(samples) < WORDS:
        return set()
    words = _cluster(samples, rng)
    vectors = np.stack([_vlad(read(i).astype(np.float32), words) for i in range(count)])
    return _nearest((vectors[i : i + 256] @ vectors.T for i in range(0, count, 256)), each_of)


def _sample(descriptors: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    rows = rng.permutation(len(descriptors))[:most]
    return np.asarray(descriptors[np.sort(rows)], dtype=np.float32)


def _cluster(samples: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return centres [WORDS, 128] by Lloyd's algorithm from random samples; an empty cluster keeps its centre."""
    words = samples[rng.choice(len(samples), WORDS, replace=False)]
    for _ in range(_ROUNDS):
        nearest = _nearest_word(samples, words)
        counts = np.bincount(nearest, minlength=WORDS)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, samples)
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words).astype(np.float32)
    return words


def _nearest_word(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.asarray(((words**2).sum(axis=1) - 2 * descriptors @ words.T).argmin(axis=1))


def _vlad(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return the VLAD vector [WORDS * 128], of unit length (zero without descriptors)."""
    vector = np.zeros_like(words, dtype=np.float32)
    if len(descriptors):
        nearest = _nearest_word(descriptors, words)
        np.add.at(vector, nearest, descriptors - words[nearest])
        vector /= np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-12)
    flat = vector.ravel()
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-12))


def _nearest(blocks: Iterable[np.ndarray], neighbours: Sequence[int]) -> set[tuple[int, int]]:
    pairs = set()
    row = 0
    for block in blocks:
        for similarity in block:
            order = np.argsort(-similarity, kind="stable")
            best = [int(j) for j in order[: neighbours[row] + 1] if j != row][: neighbours[row]]
            pairs |= {(min(row, j), max(row, j)) for j in best}
            row += 1
    return pairs
