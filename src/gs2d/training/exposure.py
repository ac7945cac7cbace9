"""One colour transform for each training photograph, learned with the splats (docs/notebook/exposure.md).

T_k = I + theta_k - mean_j theta_j: the mean of all transforms is the identity by construction, since a scene that is
twice as bright, seen by cameras half as sensitive, has the same pictures. So the scene is in the mean exposure of its
photographs. Adam moves theta_k when view k has its turn, and only then, with a memory and a count of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.config.recipe import Recipe
from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.core.photometry import CameraPhotometry
from gs2d.core.sh import rgb_to_sh0, sh_to_rgb
from gs2d.core.splats import Splats
from gs2d.errors import RunError
from gs2d.render.backends import PLAIN, Backend
from gs2d.render.exposure import identity
from gs2d.render.photometry import Shading, photograph
from gs2d.render.types import RasterSettings


@dataclass(eq=False)
class Exposures:
    """The transforms of V training views, and Adam's memory of them.

    Attributes
    ----------
    offsets : Tensor [V, 3, 4]
        theta.
    mean, square : Tensor [V, 3, 4]
        Running means of the gradient and of its square.
    steps : list of int
        Updates of each view.
    settled : bool
        The transforms were found elsewhere: I + theta, of which nothing is taken off and nothing is learned.
    """

    offsets: Tensor
    mean: Tensor
    square: Tensor
    steps: list[int]
    settled: bool = False

    @classmethod
    def given(cls, transforms: Tensor, like: Tensor) -> Exposures:
        """Return transforms [V, 3, 4] that stay as they are."""
        found = cls.start(len(transforms), like)
        known = transforms.to(like)
        return replace(found, offsets=(known - identity(known)).detach(), settled=True)

    @classmethod
    def start(cls, views: int, like: Tensor) -> Exposures:
        """Identities."""
        zeros = like.new_zeros(views, 3, 4, requires_grad=False)
        return cls(zeros, zeros.clone(), zeros.clone(), [0] * views)

    def begin_with(self, gains: np.ndarray) -> None:
        """Take gains [V, 3] of the channels as what is known of the transforms."""
        for channel in range(3):
            self.offsets[:, channel, channel] = torch.as_tensor(gains[:, channel] - 1).to(self.offsets)

    def __len__(self) -> int:
        return len(self.steps)

    def transforms(self) -> Tensor:
        """All transforms [V, 3, 4]."""
        return identity(self.offsets) + (self.offsets - self._mean())

    def _mean(self) -> Tensor | float:
        return 0.0 if self.settled else self.offsets.mean(dim=0)

    def transform(self, index: int) -> Tensor:
        """Return that of view ``index`` [3, 4], a tensor of its own."""
        return identity(self.offsets) + (self.offsets[index] - self._mean())

    def move_to(self, device: torch.device | str) -> None:
        """Move all tensors to a device."""
        self.offsets, self.mean, self.square = (t.to(device) for t in (self.offsets, self.mean, self.square))

    def state_dict(self) -> dict[str, Any]:
        """Return a deep copy in the host's memory."""
        tensors = {"offsets": self.offsets, "mean": self.mean, "square": self.square}
        return {name: tensor.detach().to("cpu", copy=True) for name, tensor in tensors.items()} | {
            "steps": list(self.steps),
            **({"settled": True} if self.settled else {}),
        }

    @classmethod
    def from_state_dict(cls, data: Mapping[str, Any]) -> Exposures:
        """Return what :meth:`state_dict` described (KeyError, TypeError, AttributeError: something else)."""
        offsets, mean, square = (data[name].clone() for name in ("offsets", "mean", "square"))
        return cls(offsets, mean, square, [int(count) for count in data["steps"]], bool(data.get("settled", False)))

    def check(self) -> None:
        """Raise ShapeError unless everything has the same V."""
        counts = torch.tensor(self.steps)
        tensors = {"exposure offsets": self.offsets, "exposure means": self.mean, "exposure squares": self.square}
        check_shapes({"exposure steps": (counts, "V")} | {name: (t, "V 3 4") for name, t in tensors.items()})


def check_views(exposures: Exposures | None, views: int) -> None:
    """Raise RunError unless there is a transform for each of so many views (0: the recipe learns none)."""
    have = 0 if exposures is None else len(exposures)
    if have != views:
        raise RunError(
            f"the checkpoint must have exposures of {views} views, as recipe and scene say, got {have}; start a new run"
        )


def _rate(recipe: Recipe, stage: int, iteration: int) -> float:
    """Return the rate at an iteration (from 1) of a stage, counted over all stages; 0 before exposures are learned."""
    assert recipe.exposure is not None
    of_run = sum(earlier.iterations for earlier in recipe.stages[:stage]) + iteration
    return recipe.exposure.rate_at(of_run) if of_run > recipe.exposure.start else 0.0


@torch.no_grad()
def exposure_step(
    exposures: Exposures,
    index: int,
    gradient: Tensor,
    recipe: Recipe,
    stage: int,
    iteration: int,
    backend: Backend = PLAIN,
) -> None:
    """One Adam update of the transform of a view, in place.

    Parameters
    ----------
    exposures : Exposures
    index : int
        The view.
    gradient : Tensor [3, 4]
        Of the loss, with respect to its transform.
    recipe : Recipe
    stage, iteration : int
        Rates decay over the whole run; before ``recipe.exposure.start`` nothing happens.
    backend : Backend
        Writes the new values. Where it does not, the count has gone on all the same (:func:`uncount`).
    """
    settings, rate = recipe.exposure, _rate(recipe, stage, iteration)
    if settings is None or rate == 0 or exposures.settled:
        return
    exposures.steps[index] += 1
    count, beta1, beta2 = exposures.steps[index], settings.beta1, settings.beta2
    rows = [tensor[index] for tensor in (exposures.offsets, exposures.mean, exposures.square)]
    mean = beta1 * rows[1] + (1 - beta1) * gradient
    square = beta2 * rows[2] + (1 - beta2) * gradient * gradient
    scale = (square / (1 - beta2**count)).sqrt() + settings.eps
    offset = rows[0] - rate / (1 - beta1**count) * mean / scale
    for row, new in zip(rows, (offset, mean, square), strict=True):
        backend.assign(row, new)


def uncount(exposures: Exposures, index: int, recipe: Recipe, stage: int, iteration: int) -> None:
    """Take back the count of an update that was cancelled on the device."""
    exposures.steps[index] -= int(_rate(recipe, stage, iteration) > 0 and not exposures.settled)


def apply_exposure(
    splats: Splats,
    camera: Camera,
    transform: Tensor,
    settings: RasterSettings,
    photometry: CameraPhotometry | None = None,
) -> tuple[Splats, RasterSettings]:
    """Return the splats in the colours that a photograph of this transform shows, and settings to draw them with.

    Their colours towards the camera are worked out, transformed, and kept as constant ones (degree 0). Vignetting is
    that of the pixel of a splat's centre.
    """
    with torch.no_grad():
        center = torch.as_tensor(camera.center).to(splats.means)
        directions = torch.nn.functional.normalize(splats.means - center, dim=1)
        degree = min(settings.sh_degree, splats.sh_degree)
        rgb = sh_to_rgb(splats.sh0, splats.shN, directions, degree)  # [N, 3]
        shading = None if photometry is None else _shading_at(splats.means, camera, photometry)
        seen = photograph(rgb[None], transform, shading=shading)[0]
        parts = dict(splats.items()) | {"sh0": rgb_to_sh0(seen)}
        return Splats(**parts), replace(settings, sh_degree=0)


def _shading_at(means: Tensor, camera: Camera, photometry: CameraPhotometry) -> Shading:
    """Return a camera's shading of points [N, 3], as a picture of one row; none beyond the reach of its corners."""
    T = torch.as_tensor(camera.T_cam_world).to(means)
    seen = means @ T[:3, :3].T + T[:3, 3]
    tangents = (seen[:, :2] / seen[:, 2:].clamp(min=1e-6)).square().sum(dim=1)
    numbers = torch.tensor([*photometry.falloff, photometry.shift]).to(means)
    return Shading(numbers, (tangents / photometry.reach**2).clamp(max=1.0)[None])
