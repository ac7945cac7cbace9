"""The interface of learned quantities: numbers of an image or a camera that change its rendering.

``QUANTITIES`` (``gs2d.config.quantities``) names the quantities. docs/extending.md adds one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.config.quantities import Quantity
from gs2d.core.camera import Camera
from gs2d.data.scene import Scene, View

MOST_CURVES = 6  # more lines in one plot are indistinguishable


@dataclass
class ImagePoints:
    """Positions of the colours that a quantity changes: pixels of an image, or centres of splats."""

    camera: Camera
    coverage: Tensor | None = None  # [H, W]: alpha of the image; None: 1 everywhere
    background: Tensor | None = None  # [3]: background colour; set with ``coverage``
    # [N, 3]: centres of splats; the colours are then [1, N, 3]. None: the colours are an image [H, W, 3].
    points: Tensor | None = None


@dataclass(frozen=True)
class QuantityReport:
    """Report of a learned quantity, for ``report.html``."""

    text: str = ""  # sentences about the learned numbers
    # Values by photograph, drawn in one plot; the keys are the legend.
    curves: Mapping[str, Sequence[float]] = field(default_factory=dict)


class LearnedQuantity:
    """Base class of learned quantities: numbers of each training image, or of each camera.

    A subclass sets ``shape`` and overrides :meth:`apply`, or :meth:`camera` and :meth:`gradient`. Rows of zeros must
    change nothing.

    Parameters
    ----------
    settings : Quantity
        The entry of the recipe: learning rate, prior and options. A subclass takes its options as keyword arguments.
    scene : Scene
        Scene with the cameras of the capture.

    Attributes
    ----------
    title : str
        Heading in the report; empty: the name of the quantity.
    shape : tuple of int
        Shape of a row.
    per_camera : bool
        Whether images whose files have the same intrinsics share a row. False: each image has its own; faces of a
        photograph share one if ``changes_color``.
    on_device : bool
        Whether the rows are stored beside the splats, so that a GPU need not wait. False: float64 in host memory.
    changes_color : bool
        Whether :meth:`apply` changes colours. Then test images and points of splats are treated alike.
    needs_moving_splats : bool
        Whether it is learned only in stages that train the means of all splats.
    learns : bool
        Whether rows are updated.
    beta1, beta2, eps : float
        Constants of Adam.
    row_of : list of int
        Row of each training view.
    """

    title = ""
    shape: tuple[int, ...] = (1,)
    per_camera = False
    on_device = False
    changes_color = True
    needs_moving_splats = False
    learns = True
    beta1, beta2, eps = 0.9, 0.999, 1e-15

    def __init__(self, settings: Quantity, scene: Scene) -> None:
        self.settings = settings
        self.views: Sequence[View] = scene.train
        of_image = (view.whole or view if self.changes_color else view for view in scene.train)
        keys = [view.file_intrinsics() for view in scene.train] if self.per_camera else list(of_image)
        rows = {key: row for row, key in enumerate(dict.fromkeys(keys))}
        self.row_of = [rows[key] for key in keys]

    @property
    def rows(self) -> int:
        """Number of rows."""
        return max(self.row_of) + 1

    def begin(self, previous: Tensor | None = None) -> Tensor:
        """Return the initial rows [G, ...]; ``previous`` are numbers of another training."""
        return torch.zeros(self.rows, *self.shape, dtype=torch.float64)

    def numbers(self, values: Tensor, index: int) -> Tensor:
        """Return the numbers of training view ``index`` from all rows, with the gauge fixed, as a new tensor.

        Subclasses remove the part of all rows that a change of the whole scene could replace.
        """
        return values[self.row_of[index]].clone()

    def leaf(self, values: Tensor, index: int, camera: Camera, like: Tensor) -> Tensor | None:
        """Return the tensor for :meth:`apply` in training, on the device of ``like``; None: it is not applied."""
        return self.numbers(values, index).to(like).requires_grad_() if self.changes_color else None

    def camera(self, values: Tensor, index: int, camera: Camera, *, learns: bool) -> Camera:
        """Return the current camera of a training view; with ``learns``, it gets a gradient."""
        return camera

    @staticmethod
    def apply(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return colours [H, W, 3] of the scene as the image shows them, differentiable in both tensors."""
        return color

    @staticmethod
    def undo(color: Tensor, numbers: Tensor, at: ImagePoints) -> Tensor:
        """Return colours [H, W, 3] of an image as the scene has them: the inverse of :meth:`apply`, for textures."""
        return color

    def penalty(self, numbers: Tensor, index: int) -> Tensor | None:
        """Return a term of the loss on the numbers of a view, or None."""
        prior = self.settings.prior
        return prior * numbers.square().sum() if prior else None

    def gradient(self, leaf: Tensor | None, index: int, camera: Camera) -> Tensor | None:
        """Return the gradient of the row of a view after the backward pass; None: the row is not updated."""
        if leaf is None:
            return None
        return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad

    def rates(self, rate: float, index: int) -> float | Tensor:
        """Return the learning rate of each number of the row of a view."""
        return rate

    def place(self, values: Tensor, scene: Scene) -> Scene:
        """Return a scene with the learned numbers in its cameras."""
        return scene

    @staticmethod
    def predicted(scene: Scene, brightness: Callable[[View], float] | None) -> Mapping[str, np.ndarray]:
        """Return numbers of test views by name, from the ``appearance`` of the training views.

        Parameters
        ----------
        scene : Scene
            Training views have their learned numbers; photographs of test views must not be used.
        brightness : callable or None
            Returns the mean brightness, from 0 to 1, of a view as the scene is rendered; None where rendering costs
            too much.

        Returns
        -------
        mapping of str to ndarray
            Views that are not named are rendered without the quantity. Default: none.
        """
        return {}

    @classmethod
    def report(cls, name: str, record: Mapping[str, Any]) -> QuantityReport | None:
        """Describe the learned numbers for the report; None where there is nothing to show.

        Parameters
        ----------
        name : str
            Name of the quantity.
        record : mapping
            ``views`` of ``learned.json`` and ``frames`` of ``poses.json``, each empty without the file.

        Returns
        -------
        QuantityReport or None
            Default: each number by photograph; the root mean square instead of more than ``MOST_CURVES`` numbers.
        """
        vectors = [np.ravel(numbers[name]) for numbers in record["views"].values() if name in numbers]
        if not vectors:
            return None
        rows = np.array(vectors, np.float64)
        text = f"Numbers of {len(rows)} photographs, from {rows.min():.3g} to {rows.max():.3g}."
        if rows.shape[1] > MOST_CURVES:
            return QuantityReport(text, {"root mean square": np.sqrt(np.square(rows).mean(axis=1)).tolist()})
        return QuantityReport(text, {f"number {k + 1}": column.tolist() for k, column in enumerate(rows.T)})
