"""All learned quantities of a recipe, with one Adam; colours of the scene as an image shows them."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES
from gs2d.config.recipe import Recipe
from gs2d.core.camera import Camera
from gs2d.core.sh import rgb_to_sh0, sh_to_rgb
from gs2d.core.splats import Splats
from gs2d.data.scene import Appearance, Scene, View
from gs2d.errors import RunError
from gs2d.kernels.torch_kernels import finite
from gs2d.render.backends import Backend
from gs2d.training.learned.quantity import ImagePoints, LearnedQuantity
from gs2d.training.state import LearnedRows

Rows = Mapping[str, LearnedRows]
"""The rows of each quantity (``TrainState.learned``)."""
Numbers = Mapping[str, Tensor]
"""Numbers of a view by the name of the quantity."""


class LearnedTable:
    """The learned quantities of a recipe on a scene. Their rows are in the training state.

    The constructor raises RecipeError if the package of a quantity cannot be imported, or it does not take its options.
    ``scene``: scene with the cameras of the capture, at full size. ``quantities`` are in the order in which they are
    applied.
    """

    def __init__(self, recipe: Recipe, scene: Scene) -> None:
        self._stages, self._scene = recipe.stages, scene
        self.quantities: dict[str, LearnedQuantity] = {
            name: QUANTITIES.make(name, settings, scene, options=settings.options)
            for name, settings in recipe.quantities.items()
        }

    @property
    def changes_color(self) -> bool:
        """Whether images have other colours than the scene."""
        return any(quantity.changes_color for quantity in self.quantities.values())

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of a row of each quantity."""
        return {name: quantity.shape for name, quantity in self.quantities.items()}

    # -- rows ------------------------------------------------------------------------------------------------------
    def start(self, like: Tensor, previous: Mapping[str, Tensor | None]) -> dict[str, LearnedRows]:
        """Return the initial rows; ``previous`` are numbers of another training.

        Raise RecipeError if a quantity needs numbers of another training for each view, and they are missing.
        """
        rows = {}
        for name, quantity in self.quantities.items():
            values = quantity.begin(previous.get(name))
            rows[name] = LearnedRows.start(values.to(like) if quantity.on_device else values)
        return rows

    def check(self, rows: Rows) -> None:
        """Raise RunError unless there are rows of each quantity, and no others."""
        for name in {**self.quantities, **rows}:
            have = len(rows[name]) if name in rows else 0
            need = self.quantities[name].rows if name in self.quantities else 0
            if have != need or (need and tuple(rows[name].values.shape[1:]) != self.quantities[name].shape):
                raise RunError(
                    f"the checkpoint must have {need} rows of {name!r} for this recipe and scene, got {have}; start a "
                    "new run"
                )

    def move_to(self, rows: Rows, device: torch.device | str) -> None:
        """Move the rows of quantities with ``on_device`` to a device."""
        for name, quantity in self.quantities.items():
            if quantity.on_device:
                rows[name].move_to(device)

    def learning(self, stage: int, iteration: int) -> dict[str, float]:
        """Return the learning rates of the quantities that an iteration (from 1) of a stage updates."""
        of_run = sum(earlier.iterations for earlier in self._stages[:stage]) + iteration
        rates = {}
        for name, quantity in self.quantities.items():
            if quantity.learns and (self._stages[stage].moves_all or not quantity.needs_moving_splats):
                rates[name] = quantity.settings.rate_at(of_run)
        return {name: rate for name, rate in rates.items() if rate > 0}

    def update(
        self, rows: Rows, index: int, gradients: Mapping[str, Tensor], rates: Mapping[str, float], backend: Backend
    ) -> None:
        """Update the rows of a view, unless the device has cancelled the iteration."""
        for name, rate in rates.items():
            quantity = self.quantities[name]
            if name not in gradients or not (quantity.on_device or backend.is_whole()):
                continue
            rows[name].adam_step(
                quantity.row_of[index],
                gradients[name],
                quantity.rates(rate, index),
                constants=(quantity.beta1, quantity.beta2, quantity.eps),
                assign=backend.assign if quantity.on_device else Tensor.copy_,
            )

    def rollback(self, rows: Rows, index: int, rates: Mapping[str, float]) -> None:
        """Undo the count of an update that the device cancelled."""
        for name in rates:
            if self.quantities[name].on_device:
                rows[name].steps[self.quantities[name].row_of[index]] -= 1

    # -- one view ----------------------------------------------------------------------------------------------------
    def camera(self, rows: Rows, index: int, camera: Camera, learning: Collection[str] = ()) -> Camera:
        """Return the current camera of a training view, with gradients for the quantities in ``learning``."""
        for name, quantity in self.quantities.items():
            camera = quantity.camera(rows[name].values, index, camera, learns=name in learning)
        return camera

    def leaves(self, rows: Rows, index: int, camera: Camera, like: Tensor) -> dict[str, Tensor]:
        """Return the tensors that ``shown`` applies to a rendering, as leaves of autograd."""
        leaves = {
            name: quantity.leaf(rows[name].values, index, camera, like) for name, quantity in self.quantities.items()
        }
        return {name: leaf for name, leaf in leaves.items() if leaf is not None}

    def numbers(self, rows: Rows, index: int, like: Tensor) -> dict[str, Tensor]:
        """Return the numbers of a view that change colours."""
        return {
            name: quantity.numbers(rows[name].values, index).to(like)
            for name, quantity in self.quantities.items()
            if quantity.changes_color
        }

    def penalties(self, leaves: Mapping[str, Tensor], index: int) -> dict[str, Tensor]:
        """Return the terms of the loss on the numbers of a view."""
        terms = {name: self.quantities[name].penalty(leaf, index) for name, leaf in leaves.items()}
        return {name: term for name, term in terms.items() if term is not None}

    def gradients(self, leaves: Mapping[str, Tensor], index: int, camera: Camera) -> dict[str, Tensor]:
        """Return the gradients of the rows of a view, after the backward pass."""
        rows = {name: quantity.gradient(leaves.get(name), index, camera) for name, quantity in self.quantities.items()}
        return {name: gradient for name, gradient in rows.items() if gradient is not None}

    # -- after training ------------------------------------------------------------------------------------------------
    def scene_now(self, rows: Rows) -> Scene:
        """Return the scene with the learned cameras and appearances of its views."""
        scene = self._scene
        for name, quantity in self.quantities.items():
            scene = quantity.place(rows[name].values, scene)
            if quantity.changes_color:
                scene = scene.with_appearance(_appearances(name, quantity, rows[name].values.cpu(), scene))
        return scene


def first_not_finite_quantity(tensors: Mapping[str, Tensor], *, waits: bool) -> str | None:
    """Return the first quantity with a NaN or an infinity; None if all are finite.

    ``waits``: also read tensors on a GPU.
    """
    readable = ((name, tensor) for name, tensor in tensors.items() if waits or tensor.device.type == "cpu")
    return next((name for name, tensor in readable if not finite(tensor)), None)


def _appearances(name: str, quantity: LearnedQuantity, values: Tensor, scene: Scene) -> dict[str, Appearance]:
    """Return the numbers of training views by name, and of test views that share a camera with them."""
    index_of = {view.name: index for index, view in enumerate(scene.train)}
    if quantity.per_camera:
        first = {view.file_intrinsics(): index for index, view in reversed(list(enumerate(scene.train)))}
        shared = ((view.name, first.get(view.file_intrinsics())) for view in scene.views)
        index_of = {view: index for view, index in shared if index is not None}
    numbers = {view: quantity.numbers(values, index) for view, index in index_of.items()}
    return {view: {name: row.detach().double().numpy()} for view, row in numbers.items()}


# -- colours --------------------------------------------------------------------------------------------------------
def shown(color: Tensor, numbers: Numbers, at: ImagePoints, clipped: Tensor | None = None) -> Tensor:
    """Return colours [H, W, 3] of the scene as an image shows them, differentiable in colours and numbers.

    ``clipped`` [H, W, 3] bool: clipped pixels of the image, which may be brighter in the scene: there the result is at
    most 1.
    """
    quantities = _ordered(numbers)
    for quantity, values in quantities:
        color = quantity.apply(color, values, at)
    if clipped is None or not any(quantity.changes_color for quantity, _ in quantities):
        return color
    return torch.where(clipped & (color.detach() > 1), 1.0, color)


@torch.no_grad()
def shown_splats(splats: Splats, camera: Camera, numbers: Numbers, sh_degree: int) -> Splats:
    """Return splats in the colours of an image, to be rendered at SH degree 0."""
    center = torch.as_tensor(camera.center).to(splats.means)
    directions = torch.nn.functional.normalize(splats.means - center, dim=1)
    rgb = sh_to_rgb(splats.sh0, splats.shN, directions, min(sh_degree, splats.sh_degree))  # [N, 3]
    color = shown(rgb[None], numbers, ImagePoints(camera, points=splats.means))[0]
    return Splats(**(dict(splats.items()) | {"sh0": rgb_to_sh0(color)}))


def unshown(color: Tensor, numbers: Numbers, at: ImagePoints) -> Tensor:
    """Return colours [H, W, 3] of an image as the scene has them: the inverse of :func:`shown`."""
    for quantity, values in reversed(_ordered(numbers)):
        color = quantity.undo(color, values, at)
    return color


def numbers_of(view: View, like: Tensor) -> dict[str, Tensor]:
    """Return the numbers of the appearance of a view, with the dtype and device of ``like``."""
    return {name: torch.as_tensor(values).to(like) for name, values in view.appearance.items()}


def _ordered(numbers: Numbers) -> list[tuple[type[LearnedQuantity], Tensor]]:
    """Return quantities and numbers in the order of the registry, in which they are applied."""
    return [(QUANTITIES.get(name), numbers[name]) for name in QUANTITIES if name in numbers]
