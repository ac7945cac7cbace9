"""The backdrop of a capture: the colour of regions without sparse points, such as a cloth behind the subject."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from gs2d.core.sh import C0, rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene

APART = 1 / 20  # of the longer side: pixels farther from every sparse point count as bare
MAX_VIEWS = 60  # images that are used, evenly chosen
STRIDE = 7  # one of this many bare pixels is used
WITHIN = 0.06  # largest difference in every channel, [0, 1], of colours that count as equal
EVEN = 2 / 3  # least fraction of bare pixels of one colour: 0.81 for a black cloth, 0.50 for a grey desk, else < 0.13
UNLIT = 0.1  # largest value of an unlit colour in every channel


@dataclass(frozen=True)
class Backdrop:
    """Colour of the bare pixels of a capture."""

    color: tuple[float, float, float]  # in [0, 1]: median of the pixels that are far from every sparse point
    alike: float  # fraction of these pixels that have nearly this colour

    @property
    def is_unlit(self) -> bool:
        """Whether the backdrop is even and dark, so that splats of its colour look like empty space."""
        return self.alike >= EVEN and max(self.color) <= UNLIT


def find_backdrop(scene: Scene) -> Backdrop | None:
    """Return the backdrop of the training images.

    None if images have an alpha channel, there are no sparse points, or no pixel is bare.
    """
    observed = None if scene.train[0].alpha() is not None else scene.observed()
    if observed is None:
        return None
    samples = []
    for view in scene.train[:: max(1, -(-len(scene.train) // MAX_VIEWS))]:
        bare = np.ones((view.camera.height, view.camera.width), dtype=bool)
        column, row = np.floor(observed.in_view(view.name, view.camera, min_track=2).pixels).astype(np.int64).T
        bare[row, column] = False
        if bare.all():
            continue  # no point in this view
        bare = distance_transform_edt(bare) > APART * max(bare.shape)
        mask = view.mask()
        if mask is not None:
            bare &= mask
        samples.append(view.target((0.0, 0.0, 0.0))[bare][::STRIDE])
    colors = np.concatenate(samples) if samples else np.zeros((0, 3))
    if not len(colors):
        return None
    red, green, blue = (round(float(value), 3) for value in np.median(colors, axis=0))
    alike = (np.abs(colors - np.array([red, green, blue])) <= WITHIN).all(axis=1)
    return Backdrop((red, green, blue), float(alike.mean()))


def in_color(splats: Splats, color: tuple[float, float, float]) -> Tensor:
    """Return which splats have nearly this colour (SH degree 0), [N] bool."""
    target = rgb_to_sh0(splats.sh0.new_tensor([color]))
    return (splats.sh0 - target).abs().amax(dim=(1, 2)) <= WITHIN / C0
