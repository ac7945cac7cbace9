"""A learned quantity: what the numbers of an image, or of a camera, do to a rendering.

``QUANTITIES`` (``gs2d.config.quantities``) names the quantities. docs/extending.md adds one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gs2d.config.quantities import Learning
from gs2d.core.camera import Camera
from gs2d.core.vignetting import reach_of
from gs2d.data.scene import Scene, View
from gs2d.render.camera_response import squares_of
from gs2d.training.targets import Target


@dataclass
class ImagePoints:
    """Where the colours are that a quantity changes: the pixels of an image, or the centres of splats.

    Attributes
    ----------
    camera : Camera
        That sees them.
    coverage : Tensor [H, W], optional
        Alpha of the photograph: 0 where there is nothing but the background. None: 1 everywhere.
    background : Tensor [3], optional
        Colour behind the photograph; given with ``coverage``.
    points : Tensor [N, 3], optional
        Centres of splats; the colours are then [1, N, 3]. None: the colours are an image [H, W, 3].
    inside : Tensor [H, W] bool, optional
        Where the rendering reaches, once a quantity has moved its pixels. Elsewhere nothing is learned.
    """

    camera: Camera
    coverage: Tensor | None = None
    background: Tensor | None = None
    points: Tensor | None = None
    inside: Tensor | None = None

    def squared_radii(self, like: Tensor) -> Tensor:
        """Return squared distances from the principal point [H, W], in focal lengths; those of points up to a corner.

        They have the type of ``like`` and are on its device.
        """
        if self.points is None:
            return squares_of(self.camera, 1.0, like)
        T = torch.as_tensor(self.camera.T_cam_world).to(self.points)
        seen = self.points @ T[:3, :3].T + T[:3, 3]
        tangents = (seen[:, :2] / seen[:, 2:].clamp(min=1e-6)).square().sum(dim=1)
        return tangents.clamp(max=reach_of([self.camera]) ** 2)[None].to(like)


class LearnedQuantity:
    """Numbers of each training image, or of each camera, that are learned with the splats.

    A subclass sets ``shape`` and overrides :meth:`apply`, or :meth:`camera` and :meth:`gradient`. Rows of zeros must
    change nothing.

    Parameters
    ----------
    settings : Learning
        Learning rate and the constants of Adam.
    scene : Scene
        With the cameras of the capture.

    Attributes
    ----------
    shape : tuple of int
        Of the numbers in a row.
    per_camera : bool
        Whether images whose files have the same intrinsics share a row. False: each image has its own.
    on_device : bool
        Whether the rows are stored beside the splats, so that a GPU need not wait. False: float64 in host memory.
    changes_color : bool
        Whether :meth:`apply` changes colours. Then test images and points of splats are treated alike.
    needs_moving_splats : bool
        Whether it is learned only in stages that train the means of all splats.
    learns : bool
        Whether rows are updated.
    limit : float or None
        Largest absolute value in a row.
    row_of : list of int
        Row of each training view.
    """

    shape: tuple[int, ...] = (1,)
    per_camera = False
    on_device = False
    changes_color = True
    needs_moving_splats = False
    learns = True
    limit: float | None = None

    def __init__(self, settings: Learning, scene: Scene) -> None:
        self.settings = settings
        self.views: Sequence[View] = scene.train
        self.row_of = list(range(len(scene.train)))
        if self.per_camera:
            known = {k: row for row, k in enumerate(dict.fromkeys(view.file_intrinsics() for view in scene.train))}
            self.row_of = [known[view.file_intrinsics()] for view in scene.train]

    @property
    def rows(self) -> int:
        """Number of rows."""
        return max(self.row_of) + 1

    def begin(self, given: Tensor | None = None) -> Tensor:
        """Return the initial rows, a Tensor [G, ...] of this shape; ``given`` are rows of another training."""
        return torch.zeros(self.rows, *self.shape, dtype=torch.float64)

    def numbers(self, values: Tensor, index: int) -> Tensor:
        """Return the numbers of training view ``index`` from all rows, with the gauge fixed: a new tensor.

        Where a change of the whole scene could stand for one of all rows, subclasses take that part out.
        """
        return values[self.row_of[index]].clone()

    def leaf(self, values: Tensor, index: int, camera: Camera, like: Tensor) -> Tensor | None:
        """Return the tensor that :meth:`apply` gets in training, on the device of ``like``; None: it is not applied."""
        return self.numbers(values, index).to(like).requires_grad_() if self.changes_color else None

    def camera(self, values: Tensor, index: int, camera: Camera, *, learns: bool) -> Camera:
        """Return the camera of a training view as it is now; with ``learns`` so that it gets a gradient."""
        return camera

    def target(self, values: Tensor, index: int, camera: Camera, target: Target) -> Target:
        """Return the photograph of a training view as a rendering of ``camera`` would show it."""
        return target

    @staticmethod
    def apply(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return colours [H, W, 3] of the scene as the photograph shows them, differentiable in both tensors."""
        return color

    @staticmethod
    def undo(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return colours [H, W, 3] of a photograph as the scene has them: the inverse of :meth:`apply`, for textures.

        By default colours stay.
        """
        return color

    def penalty(self, numbers: Tensor, index: int) -> Tensor | None:
        """Return a term of the loss on the numbers of a view, or None."""
        prior = getattr(self.settings, "prior", 0.0)
        return prior * numbers.square().sum() if prior else None

    def gradient(self, leaf: Tensor | None, index: int, camera: Camera) -> Tensor | None:
        """Return the gradient of the row of a view after the backward pass; None: nothing is learned from it."""
        if leaf is None:
            return None
        return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad

    def rates(self, rate: float, index: int) -> float | Tensor:
        """Return the learning rate of each number of the row of a view."""
        return rate

    def place(self, values: Tensor, scene: Scene) -> Scene:
        """Return a scene whose views have what was learned of them."""
        return scene
