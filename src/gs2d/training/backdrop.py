"""The colour behind everything: that of sky and bare walls, where structure from motion found nothing.

No splat can be placed there by what photographs agree on. Over black, training explains such pixels by sheets before
the cameras, and new views have black holes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from gs2d.core.sh import C0, rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene

APART = 1 / 20  # of the longer side: pixels farther from every sparse point are taken to be bare
MAX_VIEWS = 60  # that are asked, evenly chosen
STRIDE = 7  # every so many of those pixels
WITHIN = 0.06  # in every channel, [0, 1]: differences by which a colour is still that of the background
EVEN = 2 / 3  # of the bare pixels have nearly the colour: 0.81 before a black cloth, 0.50 on a grey desk, else < 0.13
UNLIT = 0.1  # in every channel: darker than a lit surface of any colour


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
    def is_unlit(self) -> bool:
        """Whether a splat of this colour says no more than empty space: all that is bare is dark and alike."""
        return self.alike >= EVEN and max(self.color) <= UNLIT


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


def in_color(splats: Splats, color: tuple[float, float, float]) -> Tensor:
    """Return which splats have nearly this colour (of degree 0), [N] bool."""
    target = rgb_to_sh0(splats.sh0.new_tensor([color]))
    return (splats.sh0 - target).abs().amax(dim=(1, 2)) <= WITHIN / C0
