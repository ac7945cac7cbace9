"""Focal length, principal point and residual lens of each camera (docs/math.md, "Focal lengths and lens")."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES, IntrinsicsRefinement
from gs2d.core.camera import Camera, Zoom
from gs2d.core.residual_lens import straightened, through_lens
from gs2d.data.scene import Scene
from gs2d.training.learned.quantity import ImagePoints, LearnedQuantity
from gs2d.training.targets import Target

_ALL = 0.999  # of the pixels that a sample is made of count, or it does not


@QUANTITIES.register("intrinsics")
class CameraIntrinsics(LearnedQuantity):
    """Five numbers a, b, c, k1 and k2 of each camera.

    The focal lengths are exp(a) times those of the capture, the principal point is moved by b and c focal lengths, and
    k1, k2 are the lens that is left (``core/residual_lens.py``) in the pinhole image that training looks at.

    Attributes
    ----------
    corners : list of float
        Squared distance of the image's corner from its centre for each camera, in focal lengths: so the rates of k1 and
        k2 mean the same at every focal length.
    """

    shape = (5,)
    per_camera = True
    changes_color = False
    needs_moving_splats = True
    settings: IntrinsicsRefinement

    def __init__(self, settings: IntrinsicsRefinement, scene: Scene) -> None:
        super().__init__(settings, scene)
        self.corners = [1.0] * self.rows
        for row, view in zip(self.row_of, scene.train, strict=True):
            c = view.camera
            self.corners[row] = (c.width / c.fx / 2) ** 2 + (c.height / c.fy / 2) ** 2

    def zoom(self, values: Tensor, index: int) -> Zoom:
        """Return what the camera of a training view has become."""
        a, *others = values[self.row_of[index]].tolist()
        return Zoom(math.exp(a), *others)

    def camera(self, values: Tensor, index: int, camera: Camera, *, learns: bool) -> Camera:
        """Return the camera of a view with its intrinsics; with ``learns`` they get a gradient.

        The intrinsics of a face of a panorama stay.
        """
        now = camera.zoomed(self.zoom(values, index))
        if not learns or self.views[index].is_face:
            return now
        numbers = torch.tensor([now.fx, now.fy, now.cx, now.cy], dtype=torch.float64, requires_grad=True)
        return replace(now, intrinsics=numbers)

    def leaf(self, values: Tensor, index: int, camera: Camera, like: Tensor) -> Tensor | None:
        """Return k1 and k2 [2], with a gradient if the intrinsics have one; None where nothing bends or learns."""
        if not self.settings.distortion:
            return None
        learns = camera.intrinsics is not None
        lens = values[self.row_of[index], 3:].clone()
        return lens.requires_grad_(learns) if learns or bool(lens.any()) else None

    @staticmethod
    def apply(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return an image as it is seen through a lens [2]."""
        seen, at.inside = through_lens(color, at.camera, numbers)
        return seen

    def target(self, values: Tensor, index: int, camera: Camera, target: Target) -> Target:
        """Return the photograph of a view without what is left of its lens."""
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
        """Return that of the five numbers [5]; zero for those that the recipe does not learn."""
        numbers = camera.intrinsics
        if numbers is None:
            return None
        found, given = torch.zeros(5, dtype=torch.float64), self.views[index].camera
        if numbers.grad is not None:  # there are splats in the image
            fx, fy, cx, cy = numbers.grad.tolist()
            moves, share = float(self.settings.principal_point), camera.width / given.width
            moved = [moves * share * cx * given.fx, moves * share * cy * given.fy]
            found[:3] = found.new_tensor([fx * camera.fx + fy * camera.fy, *moved])
        if leaf is not None and leaf.grad is not None:
            found[3:] = leaf.grad * float(self.settings.distortion)
        return found

    def rates(self, rate: float, index: int) -> Tensor:
        """Return rates [5]; those of k1 and k2 are a share of the distance from the centre to the corner."""
        corner = self.corners[self.row_of[index]]
        return rate / torch.tensor([1.0, 1.0, 1.0, corner, corner**2], dtype=torch.float64)

    def place(self, values: Tensor, scene: Scene) -> Scene:
        """Return the scene with the intrinsics of its cameras, also of test views that share a camera."""
        of_camera = {view.file_intrinsics(): self.zoom(values, k) for k, view in enumerate(scene.train)}
        known = {v.name: of_camera[v.file_intrinsics()] for v in scene.views if v.file_intrinsics() in of_camera}
        return scene.with_poses({}, known)
