"""Detect fisheye cameras.

A camera with a hint (round images, the name of an action camera, ``--camera-model OPENCV_FISHEYE``) is tested before
images are placed. A camera without a hint is tested only if its placed images leave doubts, so that ordinary captures
take no extra time. The matches decide (``lens_probe``): they are verified again as rays of a fisheye with the estimated
focal length, and COLMAP places the images with it. Runs in the worker.
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
USUAL, ROUND = 75.0, 90.0  # degrees from the axis to the corner, or to the rim, if matches do not tell
NEARLY = 0.98  # fraction of the pinhole inliers that must fit the fisheye of round images
BEND = 0.1  # test for a fisheye if distortion moves the corner inwards by more than this fraction,
ERROR = 1.0  # px; or if the mean reprojection error is larger,
PLACED = 0.5  # or if fewer of the images are placed
AS_MANY = 0.9  # a fisheye model must place at least this fraction of the images that the other lens placed

# Result for one camera: "camera" (id), "photographs" (count), "why", inlier ratios "plain" and "bent", the estimated
# ("probed") and the initial ("focal") focal length in px, "model" and "params" (None: not a fisheye).
Found = dict[str, Any]


def settle_hinted(pycolmap: Any, request: Mapping[str, Any], steps: Steps, say: Say) -> None:
    """Step "hinted": test each camera with a hint, and store the fisheyes in the database."""
    hinted = {i: group for i, group in enumerate(request["groups"], start=1) if group.get("hint")}
    found = [_test(pycolmap, request, i, group["hint"]) for i, group in hinted.items()]
    if taken := [row for row in found if row["params"]]:
        verify_anew(pycolmap, request, steps, fisheyes(pycolmap, request, taken), say)
    steps.finish(HINTED, found)


def suspects(pycolmap: Any, request: Mapping[str, Any], piece: Any | None) -> list[Found]:
    """Return the cameras without a hint that are fisheyes, although they were placed with another lens.

    Parameters
    ----------
    piece : pycolmap.Reconstruction or None
        The largest model; None if nothing was placed.
    """
    if request["asked_lens"] is not None:
        return []
    doubted = []
    for i, group in enumerate(request["groups"], start=1):
        if group["camera_model"] == START and not group.get("hint") and _is_doubted(piece, i, len(group["names"])):
            doubted.append(i)
    found = [_test(pycolmap, request, i, DOUBT) for i in doubted]
    return [row for row in found if row["params"]]


def _is_doubted(piece: Any | None, number: int, photographs: int) -> bool:
    if piece is None or number not in piece.cameras:
        return True
    placed = sum(image.has_pose and image.camera_id == number for image in piece.images.values())
    camera = piece.camera(number)
    if placed < PLACED * photographs or doubts(camera):
        return True
    return bool(corner_bend(camera) < -BEND or piece.compute_mean_reprojection_error() > ERROR)


def _test(pycolmap: Any, request: Mapping[str, Any], number: int, why: str) -> Found:
    """Test whether a camera is a fisheye; ``params`` is None if it is not."""
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
        probed = probe(pycolmap, database, camera, reach=reach, seed=request["seed"])
    finally:
        database.close()
    focal = _focal(probed, why, reach, known)
    model = "OPENCV_FISHEYE" if why == ASKED else BENT[START]
    blank = pycolmap.Camera.create_from_model_name(number, model, focal or reach, width, height)
    params = [focal] * len(blank.focal_length_idxs()) + [*centre] + [0.0] * len(blank.extra_params_idxs())
    return {
        "camera": number,
        "photographs": len(group["names"]),
        "why": why,
        "plain": probed.plain if probed else None,
        "bent": probed.bent if probed else None,
        "probed": probed.focal if probed else None,
        "focal": focal,
        "model": model,
        "params": params if focal else None,
    }


def _focal(probed: Probe | None, why: str, reach: float, known: Any) -> float | None:
    """Return the initial focal length in px; None if the camera is not a fisheye."""
    if probed is not None and (probed.is_fisheye or (why == CIRCLE and probed.bent >= NEARLY * probed.plain)):
        return probed.focal
    if why == ASKED:
        return known.mean_focal_length() if known.has_prior_focal_length else reach / math.radians(USUAL)
    return reach / math.radians(ROUND) if why == CIRCLE and probed is None else None


def fisheyes(pycolmap: Any, request: Mapping[str, Any], found: Sequence[Found]) -> list[Any]:
    """Return fisheye cameras (pycolmap.Camera) with a known focal length, so that matches are verified as rays."""
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
    """Restore the earlier lens of cameras: model, parameters, and whether the focal length is from EXIF."""
    cameras = cameras_of(pycolmap, request, [row["camera"] for row in found])
    for camera, (model, params, has_prior) in zip(cameras, before, strict=True):
        camera.model = getattr(pycolmap.CameraModelId, model)
        camera.params, camera.has_prior_focal_length = list(params), has_prior
    verify_anew(pycolmap, request, steps, cameras, say)


def cameras_of(pycolmap: Any, request: Mapping[str, Any], numbers: Sequence[int]) -> list[Any]:
    """Read cameras from the database."""
    database = pycolmap.Database.open(request["database"])
    try:
        return [database.read_camera(number) for number in numbers]
    finally:
        database.close()


def verify_anew(pycolmap: Any, request: Mapping[str, Any], steps: Steps, cameras: Sequence[Any], say: Say) -> None:
    """Store cameras in the database, and verify the matches of their images again."""
    steps.finish(CALIBRATED_ANEW, [camera.camera_id for camera in cameras])  # the pairs differ from those of `match`
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
    """Whether a model with fisheyes is better than the one with other lenses, if there is one."""
    bent = [camera for camera in fisheye.cameras.values() if is_bent(camera)]
    if any(map(doubts, bent)):
        return False
    if before is None:
        return True
    many, enough = fisheye.num_reg_images(), AS_MANY * before.num_reg_images()
    return bool(many >= enough and fisheye.compute_num_observations() >= before.compute_num_observations())
