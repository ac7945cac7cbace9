"""Estimate the focal length of a fisheye from matches alone.

As rays of an equidistant fisheye with the right focal length, all matches of two images agree with one essential
matrix. The inlier ratio over the focal length therefore has a peak. Runs in the worker, on the COLMAP database.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

PAIRS, MATCHES = 16, 300  # number of pairs, and of matches of each
FEWEST = 30  # verified matches of a pair
OVERLAP = 0.7  # fraction of the pairs, those with most matches: the others have more false matches
ANGLES = (45.0, 60.0, 75.0, 90.0, 105.0, 120.0, 135.0, 150.0)  # degrees from the axis to the corner
FINER = (-7.5, 7.5)  # degrees; tried around the best angle
WITHIN = 0.0025  # of the longer side: inlier threshold
_TRIALS = 1000  # of RANSAC


def fisheye_focal(pycolmap: Any, database: Any, camera: Any, *, seed: int) -> float | None:
    """Return the focal length in px of the equidistant fisheye that fits the matches best; None if too few pairs match.

    ``database``: with matches of pairs, verified with any lens. ``camera``: its id, size and principal point are used.
    """
    matches = _matches(pycolmap, database, camera.camera_id, seed)
    if not matches:
        return None
    centre, size = (camera.principal_point_x, camera.principal_point_y), (camera.width, camera.height)
    reach = math.hypot(*size) / 2

    def share(angle: float) -> float:
        return _share(pycolmap, (reach / math.radians(angle), *centre), size, matches, seed)

    found = {angle: share(angle) for angle in ANGLES}
    coarse = max(found, key=found.__getitem__)
    found |= {coarse + more: share(coarse + more) for more in FINER}
    return reach / math.radians(max(found, key=found.__getitem__))


def _matches(pycolmap: Any, database: Any, camera: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return matched pixels [M, 2] in both images of some pairs of one camera, by decreasing number of matches."""
    images = {image.image_id for image in database.read_all_images() if image.camera_id == camera}
    numbers, counts = database.read_two_view_geometry_num_inliers()
    pairs = [(count, *pycolmap.pair_id_to_image_pair(pair)) for pair, count in zip(numbers, counts, strict=True)]
    pairs = sorted((pair for pair in pairs if pair[0] >= FEWEST and {*pair[1:]} <= images), reverse=True)
    chosen = np.unique(np.linspace(0, OVERLAP * max(len(pairs) - 1, 0), PAIRS).astype(int)) if pairs else ()
    rng, found = np.random.Generator(np.random.Philox(key=seed)), []
    for i in chosen:
        _, first, second = pairs[i]
        rows = np.asarray(database.read_matches(first, second))
        rows = rows[np.sort(rng.permutation(len(rows))[:MATCHES])]
        places = [database.read_keypoints(image)[:, :2].astype(float) for image in (first, second)]
        found.append((places[0][rows[:, 0]], places[1][rows[:, 1]]))
    return found


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
