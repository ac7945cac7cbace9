"""Focal length, principal point and residual lens of each camera (docs/math.md, "Focal lengths and lens")."""

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
from gs2d.core.residual_lens import straightened, through_lens
from gs2d.data.scene import Scene
from gs2d.training.learned.quantity import ImagePoints, LearnedQuantity, QuantityReport
from gs2d.training.targets import Target

_ALL = 0.999  # least weight of unmasked pixels in a sample that counts


@QUANTITIES.register("intrinsics")
class CameraIntrinsics(LearnedQuantity):
    """Five numbers a, b, c, k1 and k2 of each camera.

    The focal lengths are exp(a) times those of the capture, the principal point is moved by b and c focal lengths, and
    k1, k2 are the residual lens (``core/residual_lens.py``) of the pinhole image that training uses.

    Attributes
    ----------
    corners : list of float
        Squared distance of the image corner from the centre for each camera, in focal lengths. It scales the rates of
        k1 and k2, so that they have the same effect at every focal length.
    """

    title = "Intrinsics"
    shape = (5,)
    per_camera = True
    changes_color = False
    needs_moving_splats = True

    def __init__(
        self, settings: Quantity, scene: Scene, distortion: bool = False, principal_point: bool = False
    ) -> None:
        super().__init__(settings, scene)
        for name, value in (("distortion", distortion), ("principal_point", principal_point)):
            where = f"learned.intrinsics.options.{name}"
            require(isinstance(value, bool), f"{where} must be true or false, got {value!r}")
        self.distortion, self.principal_point = distortion, principal_point
        self.corners = [1.0] * self.rows
        for row, view in zip(self.row_of, scene.train, strict=True):
            c = view.camera
            self.corners[row] = (c.width / c.fx / 2) ** 2 + (c.height / c.fy / 2) ** 2

    def zoom(self, values: Tensor, index: int) -> Zoom:
        """Return the learned change of the camera of a training view."""
        a, *others = values[self.row_of[index]].tolist()
        return Zoom(math.exp(a), *others)

    def camera(self, values: Tensor, index: int, camera: Camera, *, learns: bool) -> Camera:
        """Return the camera of a view with its intrinsics; with ``learns``, they get a gradient.

        The intrinsics of panorama faces are constant.
        """
        now = camera.zoomed(self.zoom(values, index))
        if not learns or self.views[index].is_face:
            return now
        numbers = torch.tensor([now.fx, now.fy, now.cx, now.cy], dtype=torch.float64, requires_grad=True)
        return replace(now, intrinsics=numbers)

    def leaf(self, values: Tensor, index: int, camera: Camera, like: Tensor) -> Tensor | None:
        """Return k1 and k2 [2], with a gradient if the intrinsics have one; None if they are 0 and not learned."""
        if not self.distortion:
            return None
        learns = camera.intrinsics is not None
        lens = values[self.row_of[index], 3:].clone()
        return lens.requires_grad_(learns) if learns or bool(lens.any()) else None

    @staticmethod
    def apply(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return an image as seen through a lens [2]."""
        seen, at.inside = through_lens(color, at.camera, numbers)
        return seen

    def target(self, values: Tensor, index: int, camera: Camera, target: Target) -> Target:
        """Return the target of a view without its residual lens."""
        lens = self.zoom(values, index).lens
        if lens is None:
            return target
        image, mask = straightened(target.image, camera, lens)
        silhouette = target.silhouette
        if target.mask is not None:
            mask = mask & (straightened(target.mask[..., None].to(image), camera, lens)[0][..., 0] > _ALL)
        if silhouette is not None:
            silhouette = straightened(silhouette[..., None], camera, lens)[0][..., 0]
        return Target(image, mask, None, silhouette)

    def gradient(self, leaf: Tensor | None, index: int, camera: Camera) -> Tensor | None:
        """Return the gradient of the five numbers [5]; zero for those that are not learned."""
        numbers = camera.intrinsics
        if numbers is None:
            return None
        found, given = torch.zeros(5, dtype=torch.float64), self.views[index].camera
        if numbers.grad is not None:  # None if no splat is in the image
            fx, fy, cx, cy = numbers.grad.tolist()
            moves, share = float(self.principal_point), camera.width / given.width
            moved = [moves * share * cx * given.fx, moves * share * cy * given.fy]
            found[:3] = found.new_tensor([fx * camera.fx + fy * camera.fy, *moved])
        if leaf is not None and leaf.grad is not None:
            found[3:] = leaf.grad * float(self.distortion)
        return found

    def rates(self, rate: float, index: int) -> Tensor:
        """Return rates [5]; those of k1 and k2 are relative to the distance from the centre to the corner."""
        corner = self.corners[self.row_of[index]]
        return rate / torch.tensor([1.0, 1.0, 1.0, corner, corner**2], dtype=torch.float64)

    def place(self, values: Tensor, scene: Scene) -> Scene:
        """Return the scene with the learned intrinsics, also for test views that share a camera."""
        of_camera = {view.file_intrinsics(): self.zoom(values, k) for k, view in enumerate(scene.train)}
        known = {v.name: of_camera[v.file_intrinsics()] for v in scene.views if v.file_intrinsics() in of_camera}
        return scene.with_poses({}, known)

    @classmethod
    def report(cls, name: str, record: Mapping[str, Any]) -> QuantityReport | None:
        """Return the changes of focal lengths and lenses."""
        zooms = sorted({tuple(map(float, frame["zoom"])) for frame in record["frames"] if "zoom" in frame})
        if not zooms:
            return None
        lenses = [Zoom(*zoom) for zoom in zooms]
        text = f"Focal lengths changed by a factor of {', '.join(f'{lens.scale:.4f}' for lens in lenses)}."
        distortion = ", ".join(f"k1 {lens.k1:+.4f} k2 {lens.k2:+.4f}" for lens in lenses if lens.k1 or lens.k2)
        return QuantityReport(f"{text} Distortion: {distortion}." if distortion else text)
