"""The lens of a camera: ``START`` while images are placed, then ``RICH`` if the camera has enough images; and fisheyes.

Runs in the worker, on pycolmap objects. Both models have one focal length: if all cameras are level, a vertical stretch
of the images and one of the scene are indistinguishable. The choice was measured on eleven captures
(docs/notebook/sfm.md).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.sfm.mapping import Steps
from gs2d.sfm.search import CALIBRATED_ANEW, FISHEYES

# Panoramas (``data.exif.Metadata.panorama``) are placed with COLMAP's spherical camera, one pose each; training cuts
# them into faces (``data.faces``).
PANORAMA = "EQUIRECTANGULAR"
FINER = 2  # times feature_size: a panorama covers four times the field of view of a photograph
START, RICH = "SIMPLE_RADIAL", "RADIAL"
ENOUGH = 8  # images of one camera, for a second coefficient of distortion
BEND = 0.5  # largest plausible displacement of a corner, relative to its radius; action cameras reach 0.4
FARTHEST = 4.0  # px; COLMAP's limit: a larger error is a wrong match
NARROWEST = 1.5  # degrees between the rays to a point; COLMAP's limit
ITERATIONS = 30  # of the bundle adjustment: it starts close to the solution


def with_rich_lenses(pycolmap: Any, piece: Any, *, threads: int) -> Any:
    """Return a model whose cameras with ``ENOUGH`` images have the lens ``RICH``, adjusted to it.

    The model itself is returned if there are none, or if a lens becomes implausible. ``piece``: placed with ``START``;
    cameras with other lenses keep them.
    """
    images = Counter(image.camera_id for image in piece.images.values() if image.has_pose)
    rich = [n for n, camera in piece.cameras.items() if camera.model.name == START and images[n] >= ENOUGH]
    if not rich:
        return piece
    copy = pycolmap.Reconstruction(piece)
    for number in rich:
        camera = copy.camera(number)
        params = [*camera.params, 0.0]
        camera.model = getattr(pycolmap.CameraModelId, RICH)
        camera.params = params
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-6
    pycolmap.bundle_adjustment(copy, options)
    if not all(is_plausible(copy.camera(n).params, copy.camera(n).width, copy.camera(n).height) for n in rich):
        return piece
    pycolmap.ObservationManager(copy).filter_all_points3D(FARTHEST, NARROWEST)
    copy.update_point_3d_errors()
    return copy


def is_plausible(params: Sequence[float], width: int, height: int) -> bool:
    """Whether a lens ``RICH`` (f, cx, cy, k1, k2) distorts moderately, and monotonically up to the farthest corner."""
    f, cx, cy, k1, k2 = map(float, params)
    if not (np.isfinite([f, cx, cy, k1, k2]).all() and f > 0):
        return False
    r = np.linspace(0, np.hypot(max(cx, width - cx), max(cy, height - cy)) / f, 50)
    moved = r * (1 + k1 * r**2 + k2 * r**4)
    return bool((np.diff(moved) > 0).all() and abs(moved[-1] / r[-1] - 1) <= BEND)


# -- fisheyes ----------------------------------------------------------------------------------------------------------
# COLMAP verifies no pair of fisheyes whose focal length is unknown (``--camera-model OPENCV_FISHEYE``). The matches are
# therefore verified with the lens ``START`` first, then again as rays of a fisheye with the estimated focal length.
Say = Callable[..., None]
FISHEYE = "OPENCV_FISHEYE"
USUAL = 75.0  # degrees from the axis to the corner, if neither matches nor EXIF determine the focal length


def settle_fisheyes(pycolmap: Any, request: Mapping[str, Any], steps: Steps, say: Say) -> None:
    """Step ``FISHEYES``: store each camera in the database as a fisheye, if requested."""
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
        stored = database.read_camera(number)
        camera = pycolmap.Camera.create_from_model_name(number, FISHEYE, stored.mean_focal_length(), width, height)
        focal = fisheye_focal(pycolmap, database, camera, seed=request["seed"])
    finally:
        database.close()
    if focal is None:
        usual = math.hypot(width, height) / 2 / math.radians(USUAL)
        focal = stored.mean_focal_length() if stored.has_prior_focal_length else usual
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


PAIRS, MATCHES = 16, 300  # number of pairs, and of matches of each
FEWEST = 30  # verified matches of a pair
OVERLAP = 0.7  # fraction of the pairs, those with most matches: the others have more false matches
ANGLES = (45.0, 60.0, 75.0, 90.0, 105.0, 120.0, 135.0, 150.0)  # degrees from the axis to the corner
BESIDE = (-7.5, 7.5)  # degrees; tried around the best angle
WITHIN = 0.0025  # of the longer side: inlier threshold
_TRIALS = 1000  # of RANSAC


def fisheye_focal(pycolmap: Any, database: Any, camera: Any, *, seed: int) -> float | None:
    """Return the focal length in px of the equidistant fisheye that fits the matches best; None if too few pairs match.

    As rays of a fisheye with the right focal length, all matches of two images agree with one essential matrix: the
    inlier ratio over the focal length has a peak. ``database``: with matches of pairs, verified with any lens.
    ``camera``: its id, size and principal point are used.
    """
    matches = _matches(pycolmap, database, camera.camera_id, seed)
    if not matches:
        return None
    centre, size = (camera.principal_point_x, camera.principal_point_y), (camera.width, camera.height)
    reach = math.hypot(*size) / 2

    def share(angle: float) -> float:
        return _share(pycolmap, (reach / math.radians(angle), *centre), size, matches, seed)

    shares = {angle: share(angle) for angle in ANGLES}
    coarse = max(shares, key=shares.__getitem__)
    shares |= {coarse + more: share(coarse + more) for more in BESIDE}
    return reach / math.radians(max(shares, key=shares.__getitem__))


def _matches(pycolmap: Any, database: Any, camera: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return matched pixels [M, 2] in both images of some pairs of one camera, by decreasing number of matches."""
    images = {image.image_id for image in database.read_all_images() if image.camera_id == camera}
    numbers, counts = database.read_two_view_geometry_num_inliers()
    pairs = [(count, *pycolmap.pair_id_to_image_pair(pair)) for pair, count in zip(numbers, counts, strict=True)]
    pairs = sorted((pair for pair in pairs if pair[0] >= FEWEST and {*pair[1:]} <= images), reverse=True)
    chosen = np.unique(np.linspace(0, OVERLAP * max(len(pairs) - 1, 0), PAIRS).astype(int)) if pairs else ()
    rng, matches = np.random.Generator(np.random.Philox(key=seed)), []
    for i in chosen:
        _, first, second = pairs[i]
        rows = np.asarray(database.read_matches(first, second))
        rows = rows[np.sort(rng.permutation(len(rows))[:MATCHES])]
        places = [database.read_keypoints(image)[:, :2].astype(float) for image in (first, second)]
        matches.append((places[0][rows[:, 0]], places[1][rows[:, 1]]))
    return matches


def _share(
    pycolmap: Any,
    params: Sequence[float],
    size: tuple[int, int],
    matches: Sequence[tuple[np.ndarray, np.ndarray]],
    seed: int,
) -> float:
    """Return the fraction of the matches that agree with one relative pose, as rays of a fisheye."""
    camera = pycolmap.Camera(model="SIMPLE_FISHEYE", width=size[0], height=size[1], params=list(params))
    camera.has_prior_focal_length = True
    options = pycolmap.TwoViewGeometryOptions()
    options.min_E_F_inlier_ratio, options.max_H_inlier_ratio = 0.0, 1.0  # always the essential matrix
    options.detect_watermark = False
    options.ransac.max_error = max(1.0, WITHIN * max(size))
    options.ransac.random_seed, options.ransac.max_num_trials = seed, _TRIALS
    agree = 0
    for first, second in matches:
        rows = np.repeat(np.arange(len(first), dtype=np.uint32)[:, None], 2, axis=1)
        motion = pycolmap.estimate_calibrated_two_view_geometry(camera, first, camera, second, rows, options)
        agree += len(motion.inlier_matches)
    return agree / sum(len(first) for first, _ in matches)
