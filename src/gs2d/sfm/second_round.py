"""The second round: photographs without a place are compared again, with less strict rules, and looked at twice.

The first round has to build everything from nothing, where one wrong match ruins all. Now there is a model that is
right: it can be asked for more, and what it does not support can be taken out again.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

PARTNERS = 12  # placed photographs that one without a place is compared with again: those that look most like it
NEXT = 3  # photographs before and after it in the order of names are partners too
RATIO = 0.9  # of the distances to the nearest and the second nearest feature; the first round's is 0.8
MIN_MATCHES = 12  # of a pair, once they agree with one motion; the first round's is 15
MIN_POINTS = 15  # of known place that agree on where a photograph was taken; the first round's is 30
MIN_FRACTION = 0.12  # of the candidates, likewise; the first round's is 0.25
TRIALS = 6  # how often a photograph is tried
GUIDED_BYTES = 1 << 30  # that guided matching may take: each feature of one photograph beside each of another
BYTES_A_PAIR = 9  # of features, while COLMAP compares so: 5.9 GB for photographs of 25,000 and 27,000
MIN_SEEN, WORST = 20, 2.0  # points that it must see in the end, and how far off, of the median of the others


def partners(
    lost: Iterable[str], in_order: Sequence[str], placed: set[str], likeness: Callable[[str, str], float]
) -> set[tuple[str, str]]:
    """Return the pairs to compare again, each in the order of ``in_order``.

    Parameters
    ----------
    lost : iterable of str
        Photographs without a place.
    likeness : function of two names
        Larger for photographs that share more; those that share nothing (0) are no partners.
    """
    position = {name: i for i, name in enumerate(in_order)}
    pairs = set()
    for name in lost:
        alike = sorted(((likeness(name, other), other) for other in placed), reverse=True)
        chosen = {other for much, other in alike[:PARTNERS] if much > 0}
        at = position[name]
        chosen |= set(in_order[max(0, at - NEXT) : at + NEXT + 1]) - {name}
        pairs |= {(min(name, other, key=position.__getitem__), max(name, other, key=position.__getitem__))
                  for other in chosen}  # fmt: skip
    return pairs


def forget(pycolmap: Any, request: Mapping[str, Any], pairs: Sequence[tuple[str, str]], cameras: Any) -> None:
    """Remove what is known of pairs from the database, and tell it the cameras that are known now."""
    database = pycolmap.Database.open(request["database"])
    try:
        for camera in cameras.values():
            better = copy.copy(camera)
            better.has_prior_focal_length = True
            database.update_camera(better)
        ids = {image.name: image.image_id for image in database.read_all_images()}
        for first, second in pairs:
            database.delete_matches(ids[first], ids[second])
            database.delete_two_view_geometry(ids[first], ids[second])
    finally:
        database.close()


def known(pycolmap: Any, request: Mapping[str, Any], pairs: Sequence[tuple[str, str]]) -> int:
    """How many of the pairs have been compared again: by a search that was ended meanwhile."""
    database = pycolmap.Database.open(request["database"])
    try:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        return sum(database.exists_two_view_geometry(ids[first], ids[second]) for first, second in pairs)
    finally:
        database.close()


def match_again(pycolmap: Any, request: Mapping[str, Any], pairs: Sequence[tuple[str, str]]) -> None:
    """Compare pairs once more: looser, guided by the motion that is found, with the cameras that are known now.

    Photographs with so many features that guided matching would not fit (``GUIDED_BYTES``) are compared without.
    """
    features = _features(pycolmap, request)
    most = GUIDED_BYTES / (BYTES_A_PAIR * request["threads"])
    fits = [features[first] * features[second] <= most for first, second in pairs]
    for guided in (True, False):
        _match(pycolmap, request, [pair for pair, fit in zip(pairs, fits, strict=True) if fit is guided], guided=guided)


def _features(pycolmap: Any, request: Mapping[str, Any]) -> dict[str, int]:
    """How many features each photograph has."""
    database = pycolmap.Database.open(request["database"])
    try:
        return {image.name: database.num_keypoints_for_image(image.image_id) for image in database.read_all_images()}
    finally:
        database.close()


def _match(pycolmap: Any, request: Mapping[str, Any], pairs: Sequence[tuple[str, str]], *, guided: bool) -> None:
    if not pairs:
        return
    path = request["database"]
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = request["threads"]
    matching.guided_matching = guided
    matching.sift.max_ratio = RATIO
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = MIN_MATCHES
    verification.ransac.random_seed = request["seed"]
    listed = Path(path).with_name("pairs_again.txt")
    listed.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
    chosen = pycolmap.ImportedPairingOptions()
    chosen.match_list_path = str(listed)
    pycolmap.match_image_pairs(path, matching, chosen, verification, pycolmap.Device.cpu)


def relax(options: Any) -> Any:
    """Change options of the first round's mapping into those of the second, and return them."""
    options.multiple_models = False
    options.min_num_matches = MIN_MATCHES
    options.mapper.abs_pose_min_num_inliers = MIN_POINTS
    options.mapper.abs_pose_min_inlier_ratio = MIN_FRACTION
    options.mapper.max_reg_trials = TRIALS
    return options


def refuse_unsupported(piece: Any, newcomers: Iterable[str]) -> dict[str, str]:
    """Take photographs out of a model that it does not support; returns the reason for each.

    What newcomers show each other proves nothing: photographs of another room agree among themselves. So a newcomer
    counts the points that two photographs see which are settled: those of before, and newcomers that passed.

    Parameters
    ----------
    piece : pycolmap.Reconstruction
    newcomers : iterable of str
        Those that the second round placed.
    """
    placed = {image.name: image for image in piece.images.values() if image.has_pose}
    waiting = sorted(set(newcomers) & placed.keys())
    settled = {image.image_id for name, image in placed.items() if name not in waiting}
    usual = np.median([error for i in settled for error in _errors(piece, piece.image(i), settled)] or [np.inf])
    passed = list(waiting)
    while passed:
        passed = [name for name in waiting if not _objection(piece, placed[name], settled, float(usual))]
        settled |= {placed[name].image_id for name in passed}
        waiting = [name for name in waiting if name not in passed]
    held = {image.frame_id for image in placed.values() if image.image_id in settled}  # of a rig one camera is enough
    waiting = [name for name in waiting if placed[name].frame_id not in held]
    refused = {name: _objection(piece, placed[name], settled, float(usual)) for name in waiting}
    for name in refused:
        if placed[name].has_pose:  # else it went with another of its rig
            piece.deregister_frame(placed[name].frame_id)
    return refused


def _objection(piece: Any, image: Any, settled: set[int], usual: float) -> str:
    """Why a photograph has no place; empty where it may have it."""
    errors = _errors(piece, image, settled)
    if len(errors) < MIN_SEEN:
        return f"only {len(errors)} points of known place agree on where it was taken (expected {MIN_SEEN} or more)"
    if (error := float(np.median(errors))) > WORST * usual:
        return f"points are {error:.1f} px off where it fits best ({usual:.1f} px are usual here)"
    return ""


def _errors(piece: Any, image: Any, settled: set[int]) -> list[float]:
    """px; of each point that an image sees and that two other, settled images see too."""
    errors = []
    for point in image.points2D:
        if not point.has_point3D():
            continue
        known = piece.point3D(point.point3D_id)
        others = {element.image_id for element in known.track.elements} - {image.image_id}
        if len(others & settled) >= 2:
            at = image.project_point(known.xyz)
            errors.append(np.inf if at is None else float(np.linalg.norm(at - point.xy)))
    return errors
