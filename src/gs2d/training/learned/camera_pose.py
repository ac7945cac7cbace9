"""Poses: one rigid motion for each training camera (docs/math.md, "Poses")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES, Quantity
from gs2d.core.camera import Camera
from gs2d.core.transforms import common_motion, se3_exp, similarity_motions
from gs2d.data.scene import Scene
from gs2d.training.learned.quantity import LearnedQuantity, QuantityReport


@QUANTITIES.register("poses")
class CameraPose(LearnedQuantity):
    """A motion xi_k of each camera, whose pose is se3_exp(xi_k) T_k with the pose T_k of the capture.

    xi = P theta. The projection P removes from the free numbers theta of all cameras the part that a similarity of the
    whole scene explains, because it changes no image. So the scene stays in the frame of the capture. A row is a
    rotation vector, rad, and a shift in scene extents, in the frame of the camera.
    """

    title = "Camera poses"
    shape = (6,)
    changes_color = False
    needs_moving_splats = True
    beta2 = 0.99  # a camera has one update per epoch, some hundred in all, too few for a longer memory

    def __init__(self, settings: Quantity, scene: Scene) -> None:
        super().__init__(settings, scene)
        self.initial = np.stack([view.camera.T_cam_world for view in scene.train])
        self.extent = scene.extent

    @cached_property
    def _by_similarity(self) -> np.ndarray:
        return similarity_motions(self.initial, self.extent)

    def numbers(self, values: Tensor, index: int) -> Tensor:
        """Return the motion of a camera [6]: rotation vector, rad, and shift, world units."""
        theta, J = values.numpy(), self._by_similarity
        own = theta[index] - J[index] @ common_motion(theta, J)
        return torch.from_numpy(np.concatenate([own[:3], own[3:] * self.extent]))

    def pose(self, values: Tensor, index: int) -> Tensor:
        """Return T_cam_world of a camera [4, 4] float64, a new tensor."""
        return se3_exp(self.numbers(values, index)) @ torch.from_numpy(self.initial[index])

    def camera(self, values: Tensor, index: int, camera: Camera, *, learns: bool) -> Camera:
        """Return the camera of a view at its pose; with ``learns``, the pose gets a gradient."""
        pose: Any = self.pose(values, index)
        return replace(camera, T_cam_world=pose.requires_grad_() if learns else pose)

    def gradient(self, leaf: Tensor | None, index: int, camera: Camera) -> Tensor | None:
        """Return the gradient of a motion [6], rad and extents, at the current pose."""
        pose = camera.pose
        if pose is None:
            return None
        if pose.grad is None:  # no splat is in the image
            return torch.zeros(6, dtype=torch.float64)
        by = pose.grad @ pose.detach().T  # gradient of D, for a pose (1 + D) T
        turn = (by[2, 1] - by[1, 2], by[0, 2] - by[2, 0], by[1, 0] - by[0, 1])
        return torch.stack([*turn, *(by[:3, 3] * self.extent)])

    def place(self, values: Tensor, scene: Scene) -> Scene:
        """Return the scene with its training cameras at their poses."""
        return scene.with_poses({view.name: self.pose(values, k).numpy() for k, view in enumerate(scene.train)})

    @classmethod
    def report(cls, name: str, record: Mapping[str, Any]) -> QuantityReport | None:
        """Return how far each training camera moved."""
        moved = {str(frame["name"]): frame["moved"] for frame in record["frames"] if frame["split"] == "train"}
        pixels = {view: float(motion["pixels"]) for view, motion in moved.items()}
        if not pixels:
            return None
        degrees = np.mean([motion["degrees"] for motion in moved.values()])
        farthest = max(pixels, key=pixels.__getitem__)
        text = (
            f"Training cameras moved by {np.mean(list(pixels.values())):.2f} px on average ({degrees:.3f} degrees); "
            f"{farthest} moved most ({pixels[farthest]:.2f} px). Test views keep the cameras of the capture."
        )
        return QuantityReport(text, {"motion, px": list(pixels.values())})
