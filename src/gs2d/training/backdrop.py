"""The colour behind everything: that of sky and bare walls, where structure from motion found nothing.

No splat can be placed there by what photographs agree on. Over black, training explains such pixels by sheets before
the cameras, and new views have black holes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from gs2d.config.robust import OpacityDecay
from gs2d.data.scene import Scene

APART = 1 / 20  # of the longer side: pixels farther from every sparse point are taken to be bare
MAX_VIEWS = 60  # that are asked, evenly chosen
STRIDE = 7  # every so many of those pixels
WITHIN = OpacityDecay.backdrop_within  # of the colour, in every channel: splats that near it may fade
EVEN = 2 / 3  # of the bare pixels: 0.81 before a black cloth, 0.50 on a grey desk, 0.13 and less elsewhere


@dataclass(frozen=True)
class Backdrop:
    """What lies behind everything.

    Attributes
    ----------
    color : tuple of 3 floats
        In [0, 1]: the median of the pixels of training views that are far from every sparse point.
    alike : float
        The share of those pixels that have nearly this colour.
    """

    color: tuple[float, float, float]
    alike: float

    @property
    def is_even(self) -> bool:
        """Whether a splat of this colour says no more than empty space: nearly all that is bare has it."""
        return self.alike >= EVEN


def find_backdrop(scene: Scene) -> Backdrop | None:
    """Look at the pixels of training views that are far from every sparse point.

    None where photographs have an alpha channel, which says what is empty, or there are no sparse points, or no pixel
    is bare.
    """
    observed = None if scene.train[0].alpha() is not None else scene.observed()
    if observed is None:
        return None
    found = []
    for view in scene.train[:: max(1, -(-len(scene.train) // MAX_VIEWS))]:
        bare = np.ones((view.camera.height, view.camera.width), dtype=bool)
        column, row = np.floor(observed.in_view(view.name, view.camera, min_track=2).pixels).astype(np.int64).T
        bare[row, column] = False
        if bare.all():
            continue  # not one point: nothing is known of this view
        bare = distance_transform_edt(bare) > APART * max(bare.shape)
        mask = view.mask()
        if mask is not None:
            bare &= mask
        found.append(view.target((0.0, 0.0, 0.0))[bare][::STRIDE])
    colors = np.concatenate(found) if found else np.zeros((0, 3))
    if not len(colors):
        return None
    red, green, blue = (round(float(value), 3) for value in np.median(colors, axis=0))
    alike = (np.abs(colors - np.array([red, green, blue])) <= WITHIN).all(axis=1)
    return Backdrop((red, green, blue), float(alike.mean()))
