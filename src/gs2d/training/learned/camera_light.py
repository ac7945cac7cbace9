"""Vignetting and response of each camera (docs/math.md, "Vignetting and response")."""

from __future__ import annotations

import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES, Photometry
from gs2d.core.camera import Camera
from gs2d.core.photometry import CameraPhotometry, reach_of
from gs2d.data.scene import Scene, View
from gs2d.render.photometry import show
from gs2d.training.learned.quantity import ImagePoints, LearnedQuantity


class _CameraLight(LearnedQuantity):
    """What both have in common: a light of each camera, found in its training views and known of its test views."""

    per_camera = True

    def __init__(self, settings: Photometry, scene: Scene) -> None:
        super().__init__(settings, scene)
        cameras: list[list[Camera]] = [[] for _ in range(self.rows)]
        for row, view in zip(self.row_of, scene.train, strict=True):
            cameras[row].append(view.camera)
        self.reach = list(map(reach_of, cameras))

    def light(self, values: Tensor, index: int, known: CameraPhotometry) -> CameraPhotometry:
        """Return what is known of a camera and what was learned of it."""
        raise NotImplementedError

    def place(self, values: Tensor, scene: Scene) -> Scene:
        """Return the scene with the light of its cameras."""
        first = {view.file_intrinsics(): k for k, view in reversed(list(enumerate(scene.train)))}

        def found(view: View) -> CameraPhotometry:
            index = first[view.file_intrinsics()]
            known = view.photometry or CameraPhotometry(reach=self.reach[self.row_of[index]])
            return self.light(values, index, known)

        return scene.with_photometries({v.name: found(v) for v in scene.views if v.file_intrinsics() in first})


@QUANTITIES.register("vignetting")
class Vignetting(_CameraLight):
    """Falloff of the light towards the corners of each camera; 1 at the principal point.

    Rows are a, b and c at radii whose 1 is the farthest corner. The numbers of a view are the same at radii in focal
    lengths.
    """

    shape = (3,)
    limit = 1.0  # beyond, a corner has a twentieth of the light, or twenty times too much

    def _powers(self, index: int) -> Tensor:
        """Return the powers of the reach [3] by which numbers are smaller than rows."""
        return self.reach[self.row_of[index]] ** torch.tensor([2.0, 4.0, 6.0], dtype=torch.float64)

    def numbers(self, values: Tensor, index: int) -> Tensor:
        """Return a, b and c [3] at radii in focal lengths."""
        return values[self.row_of[index]] / self._powers(index)

    @staticmethod
    def apply(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return colours with what vignetting leaves of them."""
        curve = torch.cat([numbers, numbers.new_zeros(1)])
        return show(color, curve, at.squared_radii(color), at.coverage, at.background)

    def penalty(self, numbers: Tensor, index: int) -> Tensor | None:
        """Return the weighted squares of the row."""
        return super().penalty(numbers * self._powers(index).to(numbers), index)

    def gradient(self, leaf: Tensor | None, index: int, camera: Camera) -> Tensor | None:
        """Return that of a row; zero for a face of a panorama, whose centre is not that of a lens."""
        found = super().gradient(leaf, index, camera)
        return None if found is None else found.double().cpu() / self._powers(index) * (not self.views[index].is_face)

    def light(self, values: Tensor, index: int, known: CameraPhotometry) -> CameraPhotometry:
        """Return a camera with its falloff."""
        a, b, c = values[self.row_of[index]].tolist()
        return known._replace(falloff=(a, b, c))


@QUANTITIES.register("response")
class Response(_CameraLight):
    """Curve of each camera by which light becomes a value: one number s.

    The mean of s over all images is taken off: a scene in another curve would have the same images. So a single camera
    has none, and those of several are what they differ by.
    """

    limit = 2.0

    def numbers(self, values: Tensor, index: int) -> Tensor:
        """Return s [1] of the camera of a view."""
        return values[self.row_of[index]] - values[self.row_of].mean()

    @staticmethod
    def apply(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return the values into which a camera turns light."""
        return show(color, torch.cat([numbers.new_zeros(3), numbers]), None, at.coverage, at.background)

    def gradient(self, leaf: Tensor | None, index: int, camera: Camera) -> Tensor | None:
        """Return that of s, less its share of the mean."""
        found = super().gradient(leaf, index, camera)
        share = self.row_of.count(self.row_of[index]) / len(self.row_of)
        return None if found is None else found.double().cpu() * (1 - share)

    def light(self, values: Tensor, index: int, known: CameraPhotometry) -> CameraPhotometry:
        """Return a camera with its response."""
        return known._replace(shift=float(self.numbers(values, index)))
