"""Cameras that are taken for fisheyes: those that their pictures or names tell of, and those that are nothing else.

A camera with a hint (a round picture, the name of an action camera, ``--camera-model OPENCV_FISHEYE``) is looked at
before any photograph has a place; one without a hint only where its places leave a doubt, so that ordinary captures
lose no time. What its photographs have in common decides (``lens_probe``). Its matches are then verified anew, as rays
of a fisheye of the focal length that was found, and COLMAP places it so. It runs in the worker.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gs2d.sfm.lens import ASKED, BENT, CIRCLE, DOUBT, START, corner_bend, doubts, is_bent
from gs2d.sfm.lens_probe import Probe, probe
from gs2d.sfm.search import CALIBRATED_ANEW, HINTED
from gs2d.sfm.steps import Steps

Say = Callable[..., None]
SUSPECTED, VERIFIED = "suspected", "suspected verified"  # steps
USUAL, ROUND = 75.0, 90.0  # degrees from the axis to the corner, or to the rim, where no photograph tells
NEARLY = 0.98  # of the matches that a pinhole explains must agree with the fisheye of a round picture
BEND = 0.1  # how far the corner is moved inwards, of its distance, from where on a fisheye is looked for
ERROR = 1.0  # px; mean of the model's observations, likewise
PLACED = 0.5  # of a camera's photographs: fewer with a place, likewise
AS_MANY = 0.9  # of the photographs that have a place otherwise must have one as fisheyes

# Of a camera: its number, "photographs" (how many), "why", shares of matches "plain" and "bent", the focal length that
# these tell ("probed", px) and the one to begin with ("focal"), "model" and "params" (None: it is no fisheye).
Found = dict[str, Any]


def settle_hinted(pycolmap: Any, request: Mapping[str, Any], steps: Steps, say: Say) -> None:
    """Step "hinted": what was found of each camera with a hint; those that are fisheyes are some in the database."""
    hinted = {i: group for i, group in enumerate(request["groups"], start=1) if group.get("hint")}
    found = [_looked_at(pycolmap, request, i, group["hint"]) for i, group in hinted.items()]
    if taken := [row for row in found if row["params"]]:
        verify_anew(pycolmap, request, steps, fisheyes(pycolmap, request, taken), say)
    steps.finish(HINTED, found)


def suspects(pycolmap: Any, request: Mapping[str, Any], piece: Any | None) -> list[Found]:
    """Return what was found of the cameras without a hint that are fisheyes, though they were placed as other lenses.

    Parameters
    ----------
    piece : pycolmap.Reconstruction or None
        The largest model; None: nothing was placed.
    """
    if request["asked_lens"] is not None:
        return []
    doubted = []
    for i, group in enumerate(request["groups"], start=1):
        if group["camera_model"] == START and not group.get("hint") and _is_doubted(piece, i, len(group["names"])):
            doubted.append(i)
    found = [_looked_at(pycolmap, request, i, DOUBT) for i in doubted]
    return [row for row in found if row["params"]]


def _is_doubted(piece: Any | None, number: int, photographs: int) -> bool:
    if piece is None or number not in piece.cameras:
        return True
    placed = sum(image.has_pose and image.camera_id == number for image in piece.images.values())
    camera = piece.camera(number)
    if placed < PLACED * photographs or doubts(camera):
        return True
    return bool(corner_bend(camera) < -BEND or piece.compute_mean_reprojection_error() > ERROR)


def _looked_at(pycolmap: Any, request: Mapping[str, Any], number: int, why: str) -> Found:
    """Return what a camera's photographs say of its lens; ``params`` is None where it is no fisheye."""
    group = request["groups"][number - 1]
    width, height = group["size"]
    centre, reach = (width / 2, height / 2), math.hypot(width, height) / 2
    if circle := group.get("circle"):
        centre, reach = (circle[0] * width, circle[1] * height), circle[2] * max(width, height)
    database = pycolmap.Database.open(request["database"])
    try:
        known = database.read_camera(number)
        camera = pycolmap.Camera(
            model="SIMPLE_FISHEYE", width=width, height=height, params=[reach, *centre], camera_id=number
        )
        told = probe(pycolmap, database, camera, reach=reach, seed=request["seed"])
    finally:
        database.close()
    focal = _focal(told, why, reach, known)
    model = "OPENCV_FISHEYE" if why == ASKED else BENT[START]
    blank = pycolmap.Camera.create_from_model_name(number, model, focal or reach, width, height)
    params = [focal] * len(blank.focal_length_idxs()) + [*centre] + [0.0] * len(blank.extra_params_idxs())
    return {
        "camera": number,
        "photographs": len(group["names"]),
        "why": why,
        "plain": told.plain if told else None,
        "bent": told.bent if told else None,
        "probed": told.focal if told else None,
        "focal": focal,
        "model": model,
        "params": params if focal else None,
    }


def _focal(told: Probe | None, why: str, reach: float, known: Any) -> float | None:
    """Return the focal length, px, to begin with; None: it is no fisheye."""
    if told is not None and (told.is_fisheye or (why == CIRCLE and told.bent >= NEARLY * told.plain)):
        return told.focal
    if why == ASKED:
        return known.mean_focal_length() if known.has_prior_focal_length else reach / math.radians(USUAL)
    return reach / math.radians(ROUND) if why == CIRCLE and told is None else None


def fisheyes(pycolmap: Any, request: Mapping[str, Any], found: Sequence[Found]) -> list[Any]:
    """Return the cameras (pycolmap.Camera) of what was found, of known focal length: matches are verified as rays."""
    made = []
    for row in found:
        width, height = request["groups"][row["camera"] - 1]["size"]
        camera = pycolmap.Camera(
            model=row["model"], width=width, height=height, params=row["params"], camera_id=row["camera"]
        )
        camera.has_prior_focal_length = True
        made.append(camera)
    return made


def put_back(
    pycolmap: Any,
    request: Mapping[str, Any],
    steps: Steps,
    found: Sequence[Found],
    before: Sequence[tuple[str, list[float], bool]],
    say: Say,
) -> None:
    """Give cameras that are no fisheyes the lens that they had: model, parameters, and whether EXIF told it."""
    cameras = cameras_of(pycolmap, request, [row["camera"] for row in found])
    for camera, (model, params, is_told) in zip(cameras, before, strict=True):
        camera.model = getattr(pycolmap.CameraModelId, model)
        camera.params, camera.has_prior_focal_length = list(params), is_told
    verify_anew(pycolmap, request, steps, cameras, say)


def cameras_of(pycolmap: Any, request: Mapping[str, Any], numbers: Sequence[int]) -> list[Any]:
    """Return cameras as the database has them."""
    database = pycolmap.Database.open(request["database"])
    try:
        return [database.read_camera(number) for number in numbers]
    finally:
        database.close()


def verify_anew(pycolmap: Any, request: Mapping[str, Any], steps: Steps, cameras: Sequence[Any], say: Say) -> None:
    """Give the database these cameras, and verify the matches of their photographs once more."""
    steps.finish(CALIBRATED_ANEW, [camera.camera_id for camera in cameras])  # the pairs are not those of `match` now
    numbers = {camera.camera_id for camera in cameras}
    database = pycolmap.Database.open(request["database"])
    try:
        for camera in cameras:
            database.update_camera(camera)
        images = {image.image_id: image for image in database.read_all_images()}
        pairs = []
        for pair in database.read_num_matches()[0]:
            first, second = (images[i] for i in pycolmap.pair_id_to_image_pair(pair))
            if numbers & {first.camera_id, second.camera_id}:
                database.delete_two_view_geometry(first.image_id, second.image_id)
                pairs.append((first.name, second.name))
    finally:
        database.close()
    say(phase="verifying", total=len(pairs))
    listed = Path(request["database"]).with_name("pairs_anew.txt")
    listed.write_text("".join(f"{first} {second}\n" for first, second in sorted(pairs)), encoding="utf-8")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = request["seed"]
    pycolmap.verify_matches(request["database"], str(listed), verification)


def is_better(fisheye: Any, before: Any | None) -> bool:
    """Whether a model of fisheyes is to be believed rather than the one with other lenses, if there is one."""
    bent = [camera for camera in fisheye.cameras.values() if is_bent(camera)]
    if any(map(doubts, bent)):
        return False
    if before is None:
        return True
    many, enough = fisheye.num_reg_images(), AS_MANY * before.num_reg_images()
    return bool(many >= enough and fisheye.compute_num_observations() >= before.compute_num_observations())
