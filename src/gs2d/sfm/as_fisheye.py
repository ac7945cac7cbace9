"""Estimate the focal length of fisheyes (``--camera-model OPENCV_FISHEYE``) before images are placed.

COLMAP verifies no pair of fisheyes whose focal length is unknown. The matches are therefore verified with the lens
``START`` first, then again as rays of a fisheye with the estimated focal length. Runs in the worker.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gs2d.sfm.lens_probe import fisheye_focal
from gs2d.sfm.panoramas import PANORAMA
from gs2d.sfm.search import CALIBRATED_ANEW, FISHEYES
from gs2d.sfm.steps import Steps

Say = Callable[..., None]
FISHEYE = "OPENCV_FISHEYE"
USUAL = 75.0  # degrees from the axis to the corner, if neither matches nor EXIF tell the focal length


def settle_fisheyes(pycolmap: Any, request: Mapping[str, Any], steps: Steps, say: Say) -> None:
    """Step ``FISHEYES``: store each camera in the database as a fisheye, if the request asks for that."""
    if request["asked_lens"] == FISHEYE:
        groups = enumerate(request["groups"], start=1)
        numbers = [i for i, group in groups if group["camera_model"] != PANORAMA]
        _verify_anew(pycolmap, request, steps, [_fisheye(pycolmap, request, i) for i in numbers], say)
    steps.finish(FISHEYES, True)


def _fisheye(pycolmap: Any, request: Mapping[str, Any], number: int) -> Any:
    """Return a fisheye camera (pycolmap.Camera) with an estimated focal length."""
    width, height = request["groups"][number - 1]["size"]
    database = pycolmap.Database.open(request["database"])
    try:
        known = database.read_camera(number)
        camera = pycolmap.Camera.create_from_model_name(number, FISHEYE, known.mean_focal_length(), width, height)
        focal = fisheye_focal(pycolmap, database, camera, seed=request["seed"])
    finally:
        database.close()
    if focal is None:
        usual = math.hypot(width, height) / 2 / math.radians(USUAL)
        focal = known.mean_focal_length() if known.has_prior_focal_length else usual
    camera.params = [focal, focal, *camera.params[2:]]
    camera.has_prior_focal_length = True
    return camera


def _verify_anew(pycolmap: Any, request: Mapping[str, Any], steps: Steps, cameras: Sequence[Any], say: Say) -> None:
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
