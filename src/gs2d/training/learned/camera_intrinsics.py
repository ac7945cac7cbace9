"""Focal length and principal point of each camera (docs/math.md, "Focal lengths")."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES, Quantity
from gs2d.config.validate import require
from gs2d.core.camera import Camera, Zoom
from gs2d.data.scene import Scene
from gs2d.training.learned.quantity import LearnedQuantity, QuantityReport


@QUANTITIES.register("intrinsics")
class CameraIntrinsics(LearnedQuantity):
    """Three numbers a, b and c of each camera.

    The focal lengths are exp(a) times those of the capture; the principal point is moved by b and c focal lengths.
    """

    title = "Intrinsics"
    shape = (3,)
    per_camera = True
    changes_color = False
    needs_moving_splats = True

    def __init__(self, settings: Quantity, scene: Scene, principal_point: bool = False) -> None:
        super().__init__(settings, scene)
        where = "learned.intrinsics.options.principal_point"
        require(isinstance(principal_point, bool), f"{where} must be true or false, got {principal_point!r}")
        self.principal_point = principal_point

    def zoom(self, values: Tensor, index: int) -> Zoom:
        """Return the learned change of the camera of a training view."""
        a, *others = values[self.row_of[index]].tolist()
        return Zoom(math.exp(a), *others)

    def camera(self, values: Tensor, index: int, camera: Camera, *, learns: bool) -> Camera:
        """Return the camera of a view with its intrinsics; with ``learns``, they get a gradient.

        The intrinsics of panorama faces are constant.
        """
        now = camera.zoomed(self.zoom(values, index))
        if not learns or self.views[index].whole is not None:
            return now
        numbers = torch.tensor([now.fx, now.fy, now.cx, now.cy], dtype=torch.float64, requires_grad=True)
        return replace(now, intrinsics=numbers)

    def gradient(self, leaf: Tensor | None, index: int, camera: Camera) -> Tensor | None:
        """Return the gradient of the three numbers [3]; zero for those that are not learned."""
        numbers = camera.intrinsics
        if numbers is None:
            return None
        if numbers.grad is None:  # no splat is in the image
            return torch.zeros(3, dtype=torch.float64)
        original, share = self.views[index].camera, camera.width / self.views[index].camera.width
        fx, fy, cx, cy = numbers.grad.tolist()
        moves = float(self.principal_point)
        moved = [moves * share * cx * original.fx, moves * share * cy * original.fy]
        return torch.tensor([fx * camera.fx + fy * camera.fy, *moved], dtype=torch.float64)

    def place(self, values: Tensor, scene: Scene) -> Scene:
        """Return the scene with the learned intrinsics, also for test views that share a camera."""
        of_camera = {view.file_intrinsics(): self.zoom(values, k) for k, view in enumerate(scene.train)}
        zooms = {v.name: of_camera[v.file_intrinsics()] for v in scene.views if v.file_intrinsics() in of_camera}
        return scene.with_poses({}, zooms)

    @classmethod
    def report(cls, name: str, record: Mapping[str, Any]) -> QuantityReport | None:
        """Return the changes of focal lengths."""
        scales = sorted({float(frame["zoom"][0]) for frame in record["frames"] if "zoom" in frame})
        if not scales:
            return None
        return QuantityReport(f"Focal lengths changed by a factor of {', '.join(f'{scale:.4f}' for scale in scales)}.")
