"""One rigid motion for each training camera, learned with the splats (docs/math.md, "Poses").

Camera k stands at se3_exp(xi_k) T_k, T_k its given pose, xi_k in the camera's own frame. xi = P theta: P takes out
of the free numbers theta of all cameras what one similarity of the whole scene (a motion, a scale) would do to all of
them, which no photograph could see. So the scene stays in the frame of the capture. Adam moves theta_k when view k has
its turn, and only then, with a memory and a count of its own. All of it is in the host's memory, in float64.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.config.recipe import Recipe
from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.core.transforms import common_motion, se3_exp, similarity_motions
from gs2d.errors import RunError


@dataclass(eq=False)
class Poses:
    """The motions of V training cameras, and Adam's memory of them.

    Attributes
    ----------
    given : Tensor [V, 4, 4] float64
        T_cam_world of the capture.
    extent : float
        Of the scene, world units: the unit of shifts.
    offsets : Tensor [V, 6] float64
        theta: rotation vectors, rad, then shifts in extents.
    mean, square : Tensor [V, 6] float64
        Running means of the gradient and of its square.
    steps : list of int
        Updates of each view.
    """

    given: Tensor
    extent: float
    offsets: Tensor
    mean: Tensor
    square: Tensor
    steps: list[int]

    @classmethod
    def start(cls, cameras: Sequence[Camera], extent: float) -> Poses:
        """Where the capture says."""
        given = torch.from_numpy(np.stack([camera.T_cam_world for camera in cameras]))
        zeros = torch.zeros(len(cameras), 6, dtype=torch.float64)
        return cls(given, extent, zeros, zeros.clone(), zeros.clone(), [0] * len(cameras))

    def __len__(self) -> int:
        return len(self.steps)

    @cached_property
    def _by_similarity(self) -> np.ndarray:
        return similarity_motions(self.given.numpy(), self.extent)

    def motions(self) -> Tensor:
        """All motions [V, 6]: rotation vectors, rad, and shifts, world units."""
        return torch.stack([self.motion(index) for index in range(len(self))])

    def motion(self, index: int) -> Tensor:
        """Return that of one camera [6]."""
        theta, J = self.offsets.numpy(), self._by_similarity
        own = theta[index] - J[index] @ common_motion(theta, J)
        return torch.from_numpy(np.concatenate([own[:3], own[3:] * self.extent]))

    def pose(self, index: int) -> Tensor:
        """T_cam_world of one camera [4, 4] float64, a tensor of its own."""
        return se3_exp(self.motion(index)) @ self.given[index]

    def camera(self, index: int, given: Camera, *, learns: bool = False) -> Camera:
        """Return the camera of a view as it stands now; with ``learns`` its pose gets a gradient."""
        pose: Any = self.pose(index)
        return replace(given, T_cam_world=pose.requires_grad_() if learns else pose)

    def gradient(self, camera: Camera) -> Tensor:
        """Return that of a motion [6], rad and extents, at where the camera is, from the gradient of its pose."""
        pose = camera.pose
        assert pose is not None
        if pose.grad is None:  # no splat is in the picture
            return torch.zeros(6, dtype=torch.float64)
        by = pose.grad @ pose.detach().T  # T moves to (1 + D) T: the gradient of D
        turn = (by[2, 1] - by[1, 2], by[0, 2] - by[2, 0], by[1, 0] - by[0, 1])
        return torch.stack([*turn, *(by[:3, 3] * self.extent)])

    def state_dict(self) -> dict[str, Any]:
        """Return a deep copy."""
        names = ("given", "offsets", "mean", "square")
        tensors = {name: getattr(self, name).clone() for name in names}
        return {**tensors, "extent": self.extent, "steps": list(self.steps)}

    @classmethod
    def from_state_dict(cls, data: Mapping[str, Any]) -> Poses:
        """Return what :meth:`state_dict` described (KeyError, TypeError, AttributeError: something else)."""
        given, offsets, mean, square = (data[name].clone() for name in ("given", "offsets", "mean", "square"))
        return cls(given, float(data["extent"]), offsets, mean, square, [int(count) for count in data["steps"]])

    def check(self) -> None:
        """Raise ShapeError unless everything has the same V."""
        tensors = {"pose offsets": self.offsets, "pose means": self.mean, "pose squares": self.square}
        arrays = {"pose steps": (torch.tensor(self.steps), "V"), "given poses": (self.given, "V 4 4")}
        check_shapes(arrays | {name: (tensor, "V 6") for name, tensor in tensors.items()})


def check_poses(poses: Poses | None, views: int) -> None:
    """Raise RunError unless there is a pose for each of so many views (0: the recipe learns none)."""
    have = 0 if poses is None else len(poses)
    if have != views:
        raise RunError(
            f"the checkpoint must have poses of {views} views, as recipe and scene say, got {have}; start a new run"
        )


def pose_rate(recipe: Recipe, stage: int, iteration: int) -> float:
    """Return the rate at an iteration (from 1) of a stage, counted over all stages; 0 where poses do not learn."""
    if recipe.poses is None or not recipe.stages[stage].moves_all:
        return 0.0
    return recipe.poses.rate_at(sum(earlier.iterations for earlier in recipe.stages[:stage]) + iteration)


@torch.no_grad()
def pose_step(poses: Poses, index: int, gradient: Tensor, recipe: Recipe, rate: float) -> None:
    """One Adam update of the motion of a view [6], in place."""
    settings = recipe.poses
    assert settings is not None
    poses.steps[index] += 1
    count, beta1, beta2 = poses.steps[index], settings.beta1, settings.beta2
    offset, mean, square = (tensor[index] for tensor in (poses.offsets, poses.mean, poses.square))
    mean.mul_(beta1).add_((1 - beta1) * gradient)
    square.mul_(beta2).add_((1 - beta2) * gradient * gradient)
    scale = (square / (1 - beta2**count)).sqrt() + settings.eps
    offset.sub_(rate / (1 - beta1**count) * mean / scale)
