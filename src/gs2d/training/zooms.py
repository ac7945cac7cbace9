"""Focal lengths, learned with the splats and the poses (docs/math.md, "Intrinsics").

Photographs that share a camera share three numbers: the focal lengths are exp(a) times those that the capture says, the
principal point is moved by b and c focal lengths. They act on the pinhole picture that training looks at; the lens,
which was taken out before, stays. Adam moves them whenever one of their photographs has its turn. All of it is in the
host's memory, in float64.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gs2d.config.recipe import Recipe
from gs2d.core.camera import Camera, Zoom
from gs2d.core.checks import check_shapes
from gs2d.data.scene import View
from gs2d.errors import RunError


@dataclass(eq=False)
class Zooms:
    """What is learned of G cameras, and Adam's memory of it.

    Attributes
    ----------
    group : list of int
        The camera of each training view.
    offsets, mean, square : Tensor [G, 3] float64
        a, b and c; running means of the gradient and of its square.
    steps : list of int
        Updates of each camera.
    """

    group: list[int]
    offsets: Tensor
    mean: Tensor
    square: Tensor
    steps: list[int]

    @classmethod
    def start(cls, views: Sequence[View]) -> Zooms:
        """As the capture says; views whose files have the same intrinsics share a camera."""
        cameras = {k: number for number, k in enumerate(dict.fromkeys(view.file_intrinsics() for view in views))}
        zeros = torch.zeros(len(cameras), 3, dtype=torch.float64)
        group = [cameras[view.file_intrinsics()] for view in views]
        return cls(group, zeros, zeros.clone(), zeros.clone(), [0] * len(cameras))

    def __len__(self) -> int:
        return len(self.group)

    def zoom(self, index: int) -> Zoom:
        """Return what the camera of a training view has become."""
        a, b, c = self.offsets[self.group[index]].tolist()
        return Zoom(math.exp(a), b, c)

    def camera(self, index: int, given: Camera, *, learns: bool = False) -> Camera:
        """Return the camera of a view as it stands now; with ``learns`` its intrinsics get a gradient."""
        now = given.zoomed(self.zoom(index))
        if not learns:
            return now
        numbers = torch.tensor([now.fx, now.fy, now.cx, now.cy], dtype=torch.float64, requires_grad=True)
        return replace(now, intrinsics=numbers)

    def gradient(self, camera: Camera, given: Camera) -> Tensor:
        """Return that of a, b and c [3] from the gradient of the intrinsics of ``camera``, which began as ``given``."""
        numbers = camera.intrinsics
        assert numbers is not None
        if numbers.grad is None:  # no splat is in the picture
            return torch.zeros(3, dtype=torch.float64)
        fx, fy, cx, cy = numbers.grad.tolist()
        focal = fx * camera.fx + fy * camera.fy
        return torch.tensor([focal, cx * given.fx, cy * given.fy], dtype=torch.float64)

    def state_dict(self) -> dict[str, Any]:
        """Return a deep copy."""
        tensors = {name: getattr(self, name).clone() for name in ("offsets", "mean", "square")}
        return {**tensors, "group": list(self.group), "steps": list(self.steps)}

    @classmethod
    def from_state_dict(cls, data: Mapping[str, Any]) -> Zooms:
        """Return what :meth:`state_dict` described (KeyError, TypeError, AttributeError: something else)."""
        offsets, mean, square = (data[name].clone() for name in ("offsets", "mean", "square"))
        group, steps = ([int(number) for number in data[name]] for name in ("group", "steps"))
        return cls(group, offsets, mean, square, steps)

    def check(self) -> None:
        """Raise ShapeError unless everything has the same G, and RunError for a camera that is none of them."""
        tensors = {"zooms": self.offsets, "zoom means": self.mean, "zoom squares": self.square}
        check_shapes({"zoom steps": (torch.tensor(self.steps), "G")} | {k: (t, "G 3") for k, t in tensors.items()})
        if not all(0 <= number < len(self.steps) for number in self.group):
            raise RunError("the checkpoint must number its cameras from 0, got another number; train again")


def check_zooms(zooms: Zooms | None, views: int) -> None:
    """Raise RunError unless there is a camera for each of so many views (0: the recipe learns none)."""
    have = 0 if zooms is None else len(zooms)
    if have != views:
        raise RunError(
            f"the checkpoint must have focal lengths of {views} views, as recipe and scene say, got {have}; start a "
            "new run"
        )


def zoom_rate(recipe: Recipe, stage: int, iteration: int) -> float:
    """Return the rate at an iteration (from 1) of a stage, counted over all stages; 0 where focal lengths stand."""
    if recipe.intrinsics is None or not recipe.stages[stage].moves_all:
        return 0.0
    return recipe.intrinsics.rate_at(sum(earlier.iterations for earlier in recipe.stages[:stage]) + iteration)


@torch.no_grad()
def zoom_step(zooms: Zooms, index: int, gradient: Tensor, recipe: Recipe, rate: float) -> None:
    """One Adam update of the camera of a view [3], in place; the principal point only where the recipe says so."""
    settings = recipe.intrinsics
    assert settings is not None
    if not settings.principal_point:
        gradient = gradient * torch.tensor([1.0, 0.0, 0.0], dtype=gradient.dtype)
    camera = zooms.group[index]
    zooms.steps[camera] += 1
    count, beta1, beta2 = zooms.steps[camera], settings.beta1, settings.beta2
    offset, mean, square = (tensor[camera] for tensor in (zooms.offsets, zooms.mean, zooms.square))
    mean.mul_(beta1).add_((1 - beta1) * gradient)
    square.mul_(beta2).add_((1 - beta2) * gradient * gradient)
    scale = (square / (1 - beta2**count)).sqrt() + settings.eps
    offset.sub_(rate / (1 - beta1**count) * mean / scale)
