"""Exposure and white balance: one colour transform for each training image (docs/notebook/exposure.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES, Quantity
from gs2d.config.validate import one_of
from gs2d.data.scene import Scene, View
from gs2d.errors import RecipeError
from gs2d.render.exposure_transform import expose, identity
from gs2d.training.learned.point_gains import point_gains
from gs2d.training.learned.predicted_exposure import predicted_exposures
from gs2d.training.learned.quantity import ImagePoints, LearnedQuantity, QuantityReport


@QUANTITIES.register("exposure")
class ImageExposure(LearnedQuantity):
    """A transform T_k = I + theta_k - mean_j theta_j of each image.

    The mean of all transforms is the identity, because a brighter scene with darker exposures has the same images. So
    the scene has the mean exposure of its images. Given transforms are I + theta_k, and are constant.
    """

    title = "Exposure"
    shape = (3, 4)
    on_device = True

    def __init__(self, settings: Quantity, scene: Scene, initial: str = "identity") -> None:
        super().__init__(settings, scene)
        one_of("learned.exposure.options.initial", initial, ("identity", "points", "given"))
        self.learns = initial != "given"
        self._initial, self._scene = initial, scene

    def begin(self, previous: Tensor | None = None) -> Tensor:
        """Return theta [V, 3, 4]: zeros, gains of sparse points, or previous transforms."""
        values = super().begin()
        if self._initial == "given":
            if previous is None or len(previous) != len(self.row_of):
                raise RecipeError(
                    f"learned.exposure.options.initial=given needs {len(self.row_of)} transforms, one per view, got "
                    f"{0 if previous is None else len(previous)}; only `gs2d blocks` sets it, use points or identity"
                )
            values[self.row_of] = previous.detach().to(values) - identity(values)
            return values
        gains = point_gains(self._scene) if self._initial == "points" else None
        if gains is not None:
            for channel in range(3):
                values[self.row_of, channel, channel] = torch.as_tensor(gains[:, channel] - 1)
        return values

    def numbers(self, values: Tensor, index: int) -> Tensor:
        """Return the transform of a view [3, 4]."""
        return identity(values) + (values[self.row_of[index]] - (values.mean(dim=0) if self.learns else 0.0))

    @staticmethod
    def apply(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return colours in the exposure of the image."""
        return expose(color, numbers, at.coverage, at.background)

    @staticmethod
    def undo(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return A^-1 (P - b)."""
        return (color - numbers[:, 3]) @ torch.linalg.inv(numbers[:, :3]).T

    def penalty(self, numbers: Tensor, index: int) -> Tensor:
        """Return the weighted squared difference of the transform from the identity."""
        return self.settings.prior * (numbers - identity(numbers)).square().sum()

    @staticmethod
    def predicted(scene: Scene, brightness: Callable[[View], float] | None) -> dict[str, np.ndarray]:
        """Return exposures of test views, from neighbouring photographs and the brightness of the view."""
        return predicted_exposures(scene, brightness)

    @classmethod
    def report(cls, name: str, record: Mapping[str, Any]) -> QuantityReport | None:
        """Return the brightness of each photograph relative to the mean."""
        transforms = {view: numbers[name] for view, numbers in record["views"].items() if name in numbers}
        gains = {view: exposure_gain(np.array(transform, np.float64)) for view, transform in transforms.items()}
        if not gains:
            return None
        dark, bright = min(gains, key=gains.__getitem__), max(gains, key=gains.__getitem__)
        text = (
            f"{dark} is the darkest photograph ({gains[dark]:.2f} times the mean brightness), {bright} the brightest "
            f"({gains[bright]:.2f} times). Training views are scored in the exposure of their photograph, test views "
            "in a predicted one. The mesh and new renderings use the mean exposure."
        )
        return QuantityReport(text, {"brightness, times the mean": list(gains.values())})


def exposure_gain(transform: np.ndarray) -> float:
    """Return the mean brightness of medium grey under an exposure [3, 4], relative to the scene."""
    return float(np.mean(0.5 * transform[:, :3].sum(axis=1) + transform[:, 3]) / 0.5)
