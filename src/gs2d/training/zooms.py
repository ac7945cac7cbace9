"""Focal lengths and the residual lens, learned with splats and poses (docs/math.md, "Focal lengths and lens").

Photographs that share a camera share five numbers: the focal lengths are exp(a) times those that the capture says, the
principal point is moved by b and c focal lengths, and k1, k2 are the lens that is left (``core/residual_lens.py``) in
the pinhole picture that training looks at, whose lens was taken out before. Adam moves them whenever one of their
photographs has its turn. All of it is in the host's memory, in float64.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.config.recipe import Recipe
from gs2d.core.camera import Camera, Zoom
from gs2d.core.checks import check_shapes
from gs2d.data.scene import View
from gs2d.errors import RunError

NUMBERS = 5  # of a camera
_WITHOUT_LENS = 3  # of a camera in checkpoints that knew no lens


@dataclass(eq=False)
class Zooms:
    """What is learned of G cameras, and Adam's memory of it.

    Attributes
    ----------
    group : list of int
        The camera of each training view.
    offsets, mean, square : Tensor [G, 5] float64
        a, b, c, k1 and k2; running means of the gradient and of its square.
    steps : list of int
        Updates of each camera.
    corners : list of float
        Squared distance of the picture's corner from its middle, in focal lengths: what makes the rates of k1 and k2
        mean the same at every focal length.
    """

    group: list[int]
    offsets: Tensor
    mean: Tensor
    square: Tensor
    steps: list[int]
    corners: list[float]

    @classmethod
    def start(cls, views: Sequence[View]) -> Zooms:
        """As the capture says; views whose files have the same intrinsics share a camera."""
        cameras = {k: number for number, k in enumerate(dict.fromkeys(view.file_intrinsics() for view in views))}
        zeros = torch.zeros(len(cameras), NUMBERS, dtype=torch.float64)
        group = [cameras[view.file_intrinsics()] for view in views]
        corners = [1.0] * len(cameras)
        for number, view in zip(group, views, strict=True):
            c = view.camera
            corners[number] = (c.width / c.fx / 2) ** 2 + (c.height / c.fy / 2) ** 2
        return cls(group, zeros, zeros.clone(), zeros.clone(), [0] * len(cameras), corners)

    def __len__(self) -> int:
        return len(self.group)

    def zoom(self, index: int) -> Zoom:
        """Return what the camera of a training view has become."""
        a, *others = self.offsets[self.group[index]].tolist()
        return Zoom(math.exp(a), *others)

    def lens(self, index: int, camera: Camera) -> Tensor | None:
        """Return k1 and k2 [2] of a view's camera as they stand now, with a gradient if its intrinsics have one.

        None where nothing bends and nothing learns.
        """
        learns = camera.intrinsics is not None
        numbers = self.offsets[self.group[index], 3:].clone()
        return numbers.requires_grad_(learns) if learns or bool(numbers.any()) else None

    def camera(self, index: int, given: Camera, *, learns: bool = False) -> Camera:
        """Return the camera of a view as it stands now; with ``learns`` its intrinsics get a gradient."""
        now = given.zoomed(self.zoom(index))
        if not learns:
            return now
        numbers = torch.tensor([now.fx, now.fy, now.cx, now.cy], dtype=torch.float64, requires_grad=True)
        return replace(now, intrinsics=numbers)

    def gradient(self, camera: Camera, given: Camera, lens: Tensor | None = None) -> Tensor:
        """Return that of the five numbers [5] from the gradients of the intrinsics of ``camera`` and of its ``lens``.

        ``given`` is the camera as it began.
        """
        numbers = camera.intrinsics
        assert numbers is not None
        found = torch.zeros(NUMBERS, dtype=torch.float64)
        if numbers.grad is not None:  # there are splats in the picture
            fx, fy, cx, cy = numbers.grad.tolist()
            found[:3] = found.new_tensor([fx * camera.fx + fy * camera.fy, cx * given.fx, cy * given.fy])
        if lens is not None and lens.grad is not None:
            found[3:] = lens.grad
        return found

    def state_dict(self) -> dict[str, Any]:
        """Return a deep copy."""
        tensors = {name: getattr(self, name).clone() for name in ("offsets", "mean", "square")}
        return {**tensors, "group": list(self.group), "steps": list(self.steps), "corners": list(self.corners)}

    @classmethod
    def from_state_dict(cls, data: Mapping[str, Any]) -> Zooms:
        """Return what :meth:`state_dict` described (KeyError, TypeError, AttributeError: something else)."""
        offsets, mean, square = (data[name].clone() for name in ("offsets", "mean", "square"))
        if offsets.shape[-1] == _WITHOUT_LENS:
            offsets, mean, square = (F.pad(t, (0, NUMBERS - _WITHOUT_LENS)) for t in (offsets, mean, square))
        group, steps = ([int(number) for number in data[name]] for name in ("group", "steps"))
        corners = [float(number) for number in data.get("corners", [1.0] * len(steps))]
        return cls(group, offsets, mean, square, steps, corners)

    def check(self) -> None:
        """Raise ShapeError unless everything has the same G, and RunError for a camera that is none of them."""
        tensors = {"zooms": self.offsets, "zoom means": self.mean, "zoom squares": self.square}
        lists = {"zoom steps": (torch.tensor(self.steps), "G"), "zoom corners": (torch.tensor(self.corners), "G")}
        check_shapes(lists | {name: (tensor, f"G {NUMBERS}") for name, tensor in tensors.items()})
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
    """One Adam update of the camera of a view [5], in place: of its focal length, and of what else the recipe says."""
    settings = recipe.intrinsics
    assert settings is not None
    moves, bends, camera = float(settings.principal_point), float(settings.distortion), zooms.group[index]
    gradient = gradient * gradient.new_tensor([1.0, moves, moves, bends, bends])
    corner = zooms.corners[camera]  # there the rate is a share of the distance from the middle
    rates = rate / gradient.new_tensor([1.0, 1.0, 1.0, corner, corner**2])
    zooms.steps[camera] += 1
    count, beta1, beta2 = zooms.steps[camera], settings.beta1, settings.beta2
    offset, mean, square = (tensor[camera] for tensor in (zooms.offsets, zooms.mean, zooms.square))
    mean.mul_(beta1).add_((1 - beta1) * gradient)
    square.mul_(beta2).add_((1 - beta2) * gradient * gradient)
    scale = (square / (1 - beta2**count)).sqrt() + settings.eps
    offset.sub_(rates / (1 - beta1**count) * mean / scale)
