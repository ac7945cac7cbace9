"""Test from matches alone whether a camera is a fisheye, and estimate its focal length.

For two pinhole images, all matches agree with one fundamental matrix. For two fisheye images, only matches in one part
of the images do, but as rays of an equidistant fisheye with the right focal length all agree with one essential matrix.
The inlier ratio over the focal length therefore has a peak for fisheyes, and none for other lenses. Runs in the worker,
on the COLMAP database.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

PAIRS, MATCHES = 16, 300  # number of pairs, and of matches of each
FEWEST = 30  # verified matches of a pair
OVERLAP = 0.7  # fraction of the pairs, those with most matches: the others have more false matches
CLEARLY = 1.02  # smallest ratio of fisheye inliers to pinhole inliers; ordinary lenses have 1.00
ANGLES = (45.0, 60.0, 75.0, 90.0, 105.0)  # degrees from the axis to the corner, or to the rim of the circle
FINER = (-7.5, 7.5)  # degrees; tried around the best angle
WITHIN = 0.0025  # of the longer side: inlier threshold
_TRIALS = 1000  # of RANSAC


@dataclass(frozen=True)
class Probe:
    """Inlier ratios of a camera's matches.

    Attributes
    ----------
    plain, bent : float
        Inlier ratio with a pinhole, and with the best fisheye.
    focal : float, px
        Focal length of the best fisheye, r = focal * angle.
    """

    plain: float
    bent: float
    focal: float

    @property
    def is_fisheye(self) -> bool:
        """Whether a fisheye fits clearly better."""
        return self.bent >= CLEARLY * self.plain


def probe(pycolmap: Any, database: Any, camera: Any, *, reach: float, seed: int) -> Probe | None:
    """Compare a pinhole with fisheyes of several focal lengths; None if too few pairs match.

    Parameters
    ----------
    database : pycolmap.Database
        With matches of pairs, verified with any lens.
    camera : pycolmap.Camera
        Its id, size and principal point are used.
    reach : float, px
        Distance from the principal point to the farthest corner, or to the rim of the circle.
    """
    matches = _matches(pycolmap, database, camera.camera_id, seed)
    if not matches:
        return None
    centre = (camera.principal_point_x, camera.principal_point_y)

    def share(model: str, focal: float) -> float:
        return _share(pycolmap, model, (focal, *centre), (camera.width, camera.height), matches, seed)

    plain = share("SIMPLE_PINHOLE", 1.2 * max(camera.width, camera.height))
    bent, angle = _best(lambda a: share("SIMPLE_FISHEYE", reach / math.radians(a)))
    return Probe(plain, bent, reach / math.radians(angle))


def _best(share: Callable[[float], float]) -> tuple[float, float]:
    """Return the largest inlier ratio, and its angle."""
    found = {angle: share(angle) for angle in ANGLES}
    coarse = max(found, key=lambda angle: found[angle])
    found |= {coarse + more: share(coarse + more) for more in FINER}
    return max((much, angle) for angle, much in found.items())


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
    model: str,
    params: Sequence[float],
    size: tuple[int, int],
    matches: Sequence[tuple[np.ndarray, np.ndarray]],
    seed: int,
) -> float:
    """Return the fraction of the matches that agree with one relative pose, for a camera of this model."""
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(params))
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
