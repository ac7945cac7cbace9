"""Vignetting and response of each camera, learned with the splats (docs/math.md, "Vignetting and response").

Photographs that share a camera share four numbers: three of the falloff of light towards the corners, and one of the
curve by which light becomes a value. The falloff is 1 at the principal point, and the mean curve of all photographs is
straight by construction: a scene in another curve would have the same pictures. So a single camera has none, and those
of several are what they differ by. Adam moves them whenever one of their
photographs has its turn. All of it is in the host's memory, in float64.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gs2d.config.recipe import Recipe
from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.core.photometry import CameraPhotometry, reach_of
from gs2d.data.scene import View
from gs2d.errors import RunError
from gs2d.render.photometry import Shading, squares_of

LIMITS = (1.0, 1.0, 1.0, 2.0)  # of a, b, c and s: beyond, a corner has an eighth of the light, or e^2 times too much
CENTRAL = 3  # the column of s


@dataclass(eq=False)
class Photometries:
    """What is learned of G cameras, and Adam's memory of it.

    Attributes
    ----------
    group : list of int
        The camera of each training view.
    reach : list of float
        Radius 1 of each camera, focal lengths.
    offsets, mean, square : Tensor [G, 4] float64
        a, b, c and s, of which the mean over all photographs is taken off; running means of the gradient and of its
        square.
    steps : list of int
        Updates of each camera.
    """

    group: list[int]
    reach: list[float]
    offsets: Tensor
    mean: Tensor
    square: Tensor
    steps: list[int]

    @classmethod
    def start(cls, views: Sequence[View]) -> Photometries:
        """No vignetting and straight responses; views whose files have the same intrinsics share a camera."""
        cameras = {k: number for number, k in enumerate(dict.fromkeys(view.file_intrinsics() for view in views))}
        group = [cameras[view.file_intrinsics()] for view in views]
        of_camera: list[list[Camera]] = [[] for _ in cameras]
        for number, view in zip(group, views, strict=True):
            of_camera[number].append(view.camera)
        zeros = torch.zeros(len(cameras), 4, dtype=torch.float64)
        return cls(group, list(map(reach_of, of_camera)), zeros, zeros.clone(), zeros.clone(), [0] * len(cameras))

    def __len__(self) -> int:
        return len(self.group)

    def _mean_shift(self) -> float:
        """Return the mean of s over all photographs, which is taken off."""
        return float(self.offsets[self.group, CENTRAL].mean())

    def photometry(self, index: int) -> CameraPhotometry:
        """Return what is known of the camera of a training view."""
        number = self.group[index]
        a, b, c, shift = self.offsets[number].tolist()
        return CameraPhotometry((a, b, c), self.reach[number], shift - self._mean_shift())

    def shading(self, index: int, camera: Camera, like: Tensor, *, learns: bool = False) -> Shading:
        """Return that of a view's picture, by a camera at its size; with ``learns`` its numbers get a gradient."""
        now = self.photometry(index)
        numbers = torch.tensor([*now.falloff, now.shift], dtype=torch.float64).to(like)
        return Shading(numbers.requires_grad_(learns), squares_of(camera, now.reach, like))

    def gradient(self, index: int, shading: Shading, view: View) -> Tensor:
        """Return that of a, b, c and s [4] of the camera of ``view``, the training view ``index``.

        A face has no falloff of its own: the light of its photograph falls off from elsewhere.
        """
        found = shading.numbers.grad
        if found is None:  # nothing is in the picture
            return torch.zeros(4, dtype=torch.float64)
        gradient, number = found.double().cpu(), self.group[index]
        gradient[:CENTRAL] *= not view.is_face
        gradient[CENTRAL] *= 1 - self.group.count(number) / len(self.group)  # its share of the mean
        return gradient

    def state_dict(self) -> dict[str, Any]:
        """Return a deep copy."""
        tensors = {name: getattr(self, name).clone() for name in ("offsets", "mean", "square")}
        return {**tensors, "group": list(self.group), "reach": list(self.reach), "steps": list(self.steps)}

    @classmethod
    def from_state_dict(cls, data: Mapping[str, Any]) -> Photometries:
        """Return what :meth:`state_dict` described (KeyError, TypeError, AttributeError: something else)."""
        offsets, mean, square = (data[name].clone() for name in ("offsets", "mean", "square"))
        group, steps = ([int(number) for number in data[name]] for name in ("group", "steps"))
        return cls(group, [float(number) for number in data["reach"]], offsets, mean, square, steps)

    def check(self) -> None:
        """Raise ShapeError unless everything has the same G, and RunError for a camera that is none of them."""
        tensors = {"photometries": self.offsets, "photometry means": self.mean, "photometry squares": self.square}
        counts = {"photometry steps": torch.tensor(self.steps), "photometry reaches": torch.tensor(self.reach)}
        check_shapes({k: (t, "G") for k, t in counts.items()} | {k: (t, "G 4") for k, t in tensors.items()})
        if not all(0 <= number < len(self.steps) for number in self.group):
            raise RunError("the checkpoint must number its cameras from 0, got another number; train again")
        if not all(reach > 0 for reach in self.reach):
            raise RunError("the checkpoint must have positive radii of cameras, got another; train again")


def check_photometries(photometries: Photometries | None, views: int) -> None:
    """Raise RunError unless there is a camera for each of so many views (0: the recipe learns none)."""
    have = 0 if photometries is None else len(photometries)
    if have != views:
        raise RunError(
            f"the checkpoint must have vignetting and response of {views} views, as recipe and scene say, got {have}; "
            "start a new run"
        )


def photometry_rate(recipe: Recipe, stage: int, iteration: int) -> float:
    """Return the rate at an iteration (from 1) of a stage, counted over all stages; 0 before it is learned."""
    if recipe.photometry is None:
        return 0.0
    return recipe.photometry.rate_at(sum(earlier.iterations for earlier in recipe.stages[:stage]) + iteration)


@torch.no_grad()
def photometry_step(photometries: Photometries, index: int, gradient: Tensor, recipe: Recipe, rate: float) -> None:
    """One Adam update of the camera of a view [4], in place; of what the recipe learns, and within ``LIMITS``."""
    settings = recipe.photometry
    assert settings is not None
    if rate == 0:
        return
    learned = [settings.vignetting] * 3 + [settings.response]
    gradient = gradient * torch.tensor(learned, dtype=gradient.dtype)
    camera = photometries.group[index]
    photometries.steps[camera] += 1
    count, beta1, beta2 = photometries.steps[camera], settings.beta1, settings.beta2
    offset, mean, square = (t[camera] for t in (photometries.offsets, photometries.mean, photometries.square))
    mean.mul_(beta1).add_((1 - beta1) * gradient)
    square.mul_(beta2).add_((1 - beta2) * gradient * gradient)
    scale = (square / (1 - beta2**count)).sqrt() + settings.eps
    offset.sub_(rate / (1 - beta1**count) * mean / scale)
    limits = torch.tensor(LIMITS, dtype=offset.dtype)
    offset.copy_(torch.minimum(torch.maximum(offset, -limits), limits))
