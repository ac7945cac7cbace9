"""Vignetting and response of each camera (docs/math.md, "Vignetting and response")."""

from __future__ import annotations

import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES, Quantity
from gs2d.core.camera import Camera
from gs2d.core.vignetting import reach_of
from gs2d.data.scene import Scene
from gs2d.render.camera_response import bend, show, vignetting
from gs2d.training.learned.quantity import ImagePoints, LearnedQuantity


@QUANTITIES.register("vignetting")
class Vignetting(LearnedQuantity):
    """Light falloff of each camera towards the corners; 1 at the principal point.

    Rows are a, b and c for radii relative to the farthest corner. The numbers of a view are the same for radii in focal
    lengths.
    """

    shape = (3,)
    per_camera = True
    limit = 1.0  # beyond, a corner is twenty times too dark or too bright

    def __init__(self, settings: Quantity, scene: Scene) -> None:
        super().__init__(settings, scene)
        cameras: list[list[Camera]] = [[] for _ in range(self.rows)]
        for row, view in zip(self.row_of, scene.train, strict=True):
            cameras[row].append(view.camera)
        self.reach = list(map(reach_of, cameras))

    def _powers(self, index: int) -> Tensor:
        """Return the powers of the corner radius [3], the ratios of rows and numbers."""
        return self.reach[self.row_of[index]] ** torch.tensor([2.0, 4.0, 6.0], dtype=torch.float64)

    def numbers(self, values: Tensor, index: int) -> Tensor:
        """Return a, b and c [3] at radii in focal lengths."""
        return values[self.row_of[index]] / self._powers(index)

    @staticmethod
    def apply(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return colours darkened by the falloff."""
        curve = torch.cat([numbers, numbers.new_zeros(1)])
        return show(color, curve, at.squared_radii(color), at.coverage, at.background)

    @staticmethod
    def undo(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return colours without the falloff."""
        return color / vignetting(at.squared_radii(color), numbers)[..., None]

    def penalty(self, numbers: Tensor, index: int) -> Tensor | None:
        """Return the weighted squares of the row."""
        return super().penalty(numbers * self._powers(index).to(numbers), index)

    def gradient(self, leaf: Tensor | None, index: int, camera: Camera) -> Tensor | None:
        """Return the gradient of a row; zero for panorama faces, whose centre is not that of a lens."""
        found = super().gradient(leaf, index, camera)
        return None if found is None else found.double().cpu() / self._powers(index) * (not self.views[index].is_face)


@QUANTITIES.register("response")
class Response(LearnedQuantity):
    """Response curve of each camera, from light to values: one number s.

    The mean of s over all images is subtracted, because a scene with another curve has the same images. So only the
    differences between cameras are learned.
    """

    per_camera = True
    limit = 2.0

    def numbers(self, values: Tensor, index: int) -> Tensor:
        """Return s [1] of the camera of a view."""
        return values[self.row_of[index]] - values[self.row_of].mean()

    @staticmethod
    def apply(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return the values that a camera makes of light."""
        return show(color, torch.cat([numbers.new_zeros(3), numbers]), None, at.coverage, at.background)

    @staticmethod
    def undo(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return the light of values."""
        return bend(color, -numbers[0])

    def gradient(self, leaf: Tensor | None, index: int, camera: Camera) -> Tensor | None:
        """Return the gradient of s, without its part in the mean."""
        found = super().gradient(leaf, index, camera)
        share = self.row_of.count(self.row_of[index]) / len(self.row_of)
        return None if found is None else found.double().cpu() * (1 - share)
