"""Whether a camera's lens is a fisheye, and of which focal length: by what its photographs have in common.

No place is known yet. Of two photographs through a pinhole, or nearly one, all matches agree with one fundamental
matrix, whatever the focal length; through a fisheye only those do that lie in one part of the pictures. As rays of an
equidistant fisheye of the right focal length they all agree with one essential matrix. So the share of matches that
agree has a peak at the focal length of a fisheye, and none for other lenses: there a fisheye of any focal length is as
good as a pinhole. It runs in the worker, on COLMAP's own database.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

PAIRS, MATCHES = 16, 300  # that are looked at; of each pair so many matches
FEWEST = 30  # matches that agree with one motion, or a pair tells nothing
OVERLAP = 0.7  # of the pairs, those with most matches first: others have more false ones
CLEARLY = 1.02  # times as many matches must agree through a fisheye; ordinary lenses have 1.00
ANGLES = (45.0, 60.0, 75.0, 90.0, 105.0)  # degrees from the axis to the corner, or to the rim of the circle
FINER = (-7.5, 7.5)  # degrees beside the best of them
WITHIN = 0.0025  # of the longer side: how far, px, matches that agree may be off
_TRIALS = 1000  # of drawing a motion at random


@dataclass(frozen=True)
class Probe:
    """What a camera's photographs say of its lens.

    Attributes
    ----------
    plain, bent : float
        Share of the matches that agree with one motion: through a pinhole, and through the best fisheye.
    focal : float
        px; of the best fisheye, r = focal * angle.
    """

    plain: float
    bent: float
    focal: float

    @property
    def is_fisheye(self) -> bool:
        """Whether a fisheye explains clearly more."""
        return self.bent >= CLEARLY * self.plain


def probe(pycolmap: Any, database: Any, camera: Any, *, reach: float, seed: int) -> Probe | None:
    """Return what the photographs of a camera say of its lens; None where too few pairs show the same points.

    Parameters
    ----------
    database : pycolmap.Database
        With matches of pairs, verified by any lens.
    camera : pycolmap.Camera
        Its size and principal point are taken.
    reach : float
        px from the principal point to the farthest corner, or to the rim of the circle.
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
    """Return the largest share, and its angle."""
    found = {angle: share(angle) for angle in ANGLES}
    coarse = max(found, key=lambda angle: found[angle])
    found |= {coarse + more: share(coarse + more) for more in FINER}
    return max((much, angle) for angle, much in found.items())


def _matches(pycolmap: Any, database: Any, camera: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return places px [M, 2] in both photographs of pairs of one camera, from pairs with many matches to few."""
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
    """Return which share of the matches agrees with one motion of a camera of this model."""
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(params))
    camera.has_prior_focal_length = True
    options = pycolmap.TwoViewGeometryOptions()
    options.min_E_F_inlier_ratio, options.max_H_inlier_ratio = 0.0, 1.0  # the essential matrix, whatever else fits
    options.detect_watermark = False
    options.ransac.max_error = max(1.0, WITHIN * max(size))
    options.ransac.random_seed, options.ransac.max_num_trials = seed, _TRIALS
    agree = 0
    for first, second in matches:
        rows = np.repeat(np.arange(len(first), dtype=np.uint32)[:, None], 2, axis=1)
        motion = pycolmap.estimate_calibrated_two_view_geometry(camera, first, camera, second, rows, options)
        agree += len(motion.inlier_matches)
    return agree / sum(len(first) for first, _ in matches)
