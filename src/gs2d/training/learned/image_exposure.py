"""Exposure and white balance: one colour transform for each training image (docs/notebook/exposure.md)."""

from __future__ import annotations

import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES, Exposure
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.render.exposure_transform import expose, identity
from gs2d.training.learned.quantity import ImagePoints, LearnedQuantity
from gs2d.training.point_gains import point_gains


@QUANTITIES.register("exposure")
class ImageExposure(LearnedQuantity):
    """A transform T_k = I + theta_k - mean_j theta_j of each image.

    The mean of all transforms is the identity: a scene that is twice as bright, seen by cameras half as sensitive, has
    the same images. So the scene is in the mean exposure of its images. Given transforms are I + theta_k, and stay.
    """

    shape = (3, 4)
    on_device = True
    settings: Exposure

    def __init__(self, settings: Exposure, scene: Scene) -> None:
        super().__init__(settings, scene)
        self.learns = settings.initial != "given"
        self._scene = scene

    def begin(self, given: Tensor | None = None) -> Tensor:
        """Return theta [V, 3, 4]: zeros, gains of sparse points, or what was given."""
        values = super().begin()
        if self.settings.initial == "given":
            if given is None or len(given) != len(values):
                raise RecipeError(
                    f"exposure.initial=given needs a transform of each of {len(values)} training views, got "
                    f"{'none' if given is None else len(given)}; `gs2d blocks` gives them, elsewhere take points or "
                    "identity"
                )
            return given.detach().to(values) - identity(values)
        found = point_gains(self._scene) if self.settings.initial == "points" else None
        if found is not None:
            for channel in range(3):
                values[:, channel, channel] = torch.as_tensor(found.gains[:, channel] - 1)
        return values

    def numbers(self, values: Tensor, index: int) -> Tensor:
        """Return the transform of a view [3, 4]."""
        return identity(values) + (values[index] - (values.mean(dim=0) if self.learns else 0.0))

    @staticmethod
    def apply(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return colours in the exposure of the photograph."""
        return expose(color, numbers, at.coverage, at.background)

    @staticmethod
    def undo(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return A^-1 (P - b)."""
        return (color - numbers[:, 3]) @ torch.linalg.inv(numbers[:, :3]).T

    def penalty(self, numbers: Tensor, index: int) -> Tensor:
        """Return the weighted squares of what the transform differs from the identity by."""
        return self.settings.prior * (numbers - identity(numbers)).square().sum()
