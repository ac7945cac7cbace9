"""The cuda backend: the CUDA kernels on NVIDIA GPUs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, Self, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from gs2d.core.splats import ATTRIBUTES, IMAGES
from gs2d.kernels import torch_kernels
from gs2d.kernels.adam_update import AdamUpdate
from gs2d.kernels.cuda import cuda_adam, diagnose, launch
from gs2d.kernels.cuda.cuda_losses import CudaLosses
from gs2d.kernels.cuda.launch import Launcher
from gs2d.kernels.tsdf import FusionOnDevice
from gs2d.render.backends import register_backend
from gs2d.render.cuda_passes import (
    CHANNELS,
    HIDDEN,
    SAVED,
    ForwardState,
    backward,
    blend_features,
    errors,
    forward,
    view_of,
)
from gs2d.render.cuda_step import Stepper
from gs2d.render.kernel_backend import Gradients, KernelBackend, ViewOfSplats
from gs2d.render.pair_budget import PairBudget
from gs2d.render.types import Features
from gs2d.render.whole_step import WholeStep

T = TypeVar("T")


@register_backend("cuda")
class CudaBackend(KernelBackend):
    """The CUDA kernels.

    Training does not wait for the device: instead of reading the number of pairs of splat and tile, a rendering
    reserves memory for a quarter more than the largest number so far (:class:`PairBudget`). An iteration that needed
    more changes nothing and is repeated. Without a ``budget`` each rendering waits for its number of pairs.

    The ``launcher`` runs the kernels; by default it is that of the tensors' device. ``exact_masks=False`` disables
    culling inside tiles, which changes no bit of the image (tests). ``deterministic`` gives the same gradients bit for
    bit from run to run, for one more pass and 320 bytes for each pair of splat and tile, and 16 more bytes for each
    further channel; None: as torch.use_deterministic_algorithms says.
    """

    name = "cuda"
    device = "cuda"

    def __init__(
        self,
        budget: PairBudget | None = None,
        *,
        launcher: Launcher | None = None,
        exact_masks: bool = True,
        deterministic: bool | None = None,
    ) -> None:
        self._budget, self._fixed = budget, launcher
        self._exact_masks, self._deterministic = exact_masks, deterministic
        self._last: tuple[Callable[[], Any], Callable[[], None]] | None = None  # the iteration that may be repeated
        self._stepper: Stepper | None = None

    @classmethod
    def ready(cls) -> Self:
        """Return the backend, or raise BackendError with the first thing that this machine lacks."""
        ready = cls()
        ready.about = _machine()
        return ready

    def _launcher(self, device: torch.device) -> Launcher:
        return self._fixed or launch.launcher_for(device)

    def forward_pass(
        self, scene: ViewOfSplats, features: Features | None
    ) -> tuple[dict[str, Tensor], dict[str, Tensor], Any]:
        """Render one view, deterministically."""
        settings, launcher = scene.settings, self._launcher(scene.splats["means"].device)
        sure = torch.are_deterministic_algorithms_enabled() if self._deterministic is None else self._deterministic
        frame = forward(
            launcher,
            view_of(scene.camera, settings),
            scene.splats,
            exact=self._exact_masks,
            distortion=settings.with_distortion,
            transmittance=settings.with_transmittance_depth,
            whole_lists=features is not None,
            budget=self._budget,
        )
        hidden = frame.images | {name: getattr(frame, name) for name in SAVED}
        outputs = {name: hidden.pop(name) for name in IMAGES} | {"radii": frame.radii}
        if settings.with_transmittance_depth:
            outputs["depth_transmittance"] = hidden.pop("depth_transmittance")
        if features is not None:
            blended = blend_features(launcher, frame, *_padded(features.values, features.background))
            further = blended[: features.values.shape[1]].permute(1, 2, 0)
            outputs["color"] = torch.cat([outputs["color"], further], dim=2)
        return outputs, hidden, (launcher, frame.view, sure)

    def backward_pass(self, state: Any, grads: Gradients) -> None:
        """Compute gradients of a forward pass; if only colours have some, a shorter pass runs.

        They are summed by atomic additions, so on a GPU their last digits vary from run to run, unless
        ``deterministic``.
        """
        launcher, view, sure = state
        saved, outputs, further, to_values = grads.saved, dict(grads.outputs), None, None
        splats = {name: saved[name] for name in ATTRIBUTES}
        images = {name: saved[name] for name in (*IMAGES, *HIDDEN)}
        frame = ForwardState(view=view, images=images, radii=saved["radii"], **{name: saved[name] for name in SAVED})
        upstream: dict[str, Tensor | None] = dict.fromkeys((*IMAGES, "depth_transmittance")) | dict(grads.upstream)
        if len(saved["moments"]) == 0:
            upstream["distortion"] = None  # a constant
        values = outputs.pop("values")
        if grads.wide is not None:
            further, to_values = _further(saved, grads.wide)
        if outputs["intrinsics"] is not None:
            outputs["intrinsics"].zero_()
        backward(launcher, frame, splats, upstream, outputs, learns=grads.rows, deterministic=sure, features=further)
        if values is not None and to_values is not None:
            values.copy_(to_values[:, : values.shape[1]])

    def errors_pass(self, scene: ViewOfSplats, image: Tensor, mask: Tensor | None, occlusion: bool) -> Tensor:
        """Return the splat errors [N] of one view, deterministic.

        With ``occlusion``, an error above 1e9 within 8x8 pixels counts as 1e9.
        """
        view = view_of(scene.camera, scene.settings)
        return errors(self._launcher(image.device), view, scene.splats, image, mask, occlusion)

    def loss_operations(self, device: torch.device) -> CudaLosses:
        """Return the fused operations for the losses; caching the local mean of a target would save no time."""
        return CudaLosses(self._launcher(device))

    def fusion(self) -> FusionOnDevice:
        """Return what fuses depth maps into volumes."""
        device = torch.device(self.device)
        return FusionOnDevice(self._launcher(device), device)

    def for_training(self) -> CudaBackend:
        """Return a backend with a budget; torch's memory segments may grow from now on."""
        launch.grow_in_place()
        return type(self)(
            PairBudget(), launcher=self._fixed, exact_masks=self._exact_masks, deterministic=self._deterministic
        )

    def iterate(self, update: Callable[[], T], *, rollback: Callable[[], None], exact: bool) -> T:
        """Run an iteration; first repeat the previous one if it lacked pairs."""
        budget = self._budget
        if budget is None:
            return update()
        if self._last is not None and budget.overflowed():
            again, undo = self._last
            undo()
            budget.exact = True
            again()
        budget.exact = exact
        self._last = update, rollback
        return update()

    def takes_whole_steps(self) -> bool:
        """Whether this is an iteration of a training whose results are not read afterwards."""
        budget = self._budget
        if budget is None:
            return False
        if budget.exact and self._stepper is not None:
            self._stepper.release()
        return not budget.exact and not torch.are_deterministic_algorithms_enabled()

    def step(self, step: WholeStep) -> bool:
        """Run an iteration with kernels alone (:mod:`gs2d.render.cuda_step`)."""
        if self._budget is None or not self.takes_whole_steps():
            return False
        if self._stepper is None:
            launch.steps()  # refuses an unknown value before anything is done
            device = step.splats.device
            self._stepper = Stepper(self._launcher(device), device)
        return self._stepper.run(step, self._budget)

    def _overflow(self) -> Tensor | None:
        """Return whether a rendering of this iteration lacks pairs, [] int32 on the device; None: none can."""
        return None if self._budget is None else self._budget.overflow

    def adam_step(self, updates: Sequence[AdamUpdate], *, beta1: float, beta2: float, eps: float) -> None:
        """Run one Adam step on several attributes in one launch."""
        if not updates:
            return
        launcher, betas = self._launcher(updates[0].parameter.device), {"beta1": beta1, "beta2": beta2, "eps": eps}
        cuda_adam.adam_step(updates, **betas, launcher=launcher, skip=self._overflow())

    def accumulate(self, signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor) -> None:
        """Add a densification signal."""
        overflow = self._overflow()
        visible = radii if overflow is None else radii * (1 - overflow)
        torch_kernels.accumulate(signed, absolute, count, signal, visible)

    def assign(self, target: Tensor, value: Tensor) -> None:
        """Copy a value into a tensor."""
        overflow = self._overflow()
        target.copy_(value if overflow is None else torch.where(overflow != 0, target, value))

    def is_whole(self) -> bool:
        """Whether the images of this iteration are complete; waits for the device."""
        overflow = self._overflow()
        return overflow is None or int(overflow) == 0


@cache  # the machine is examined once; an error is not cached
def _machine() -> str:
    """Return a line about this machine, or raise BackendError."""
    return diagnose.machine()


def _padded(*tensors: Tensor) -> list[Tensor]:
    """Return tensors [..., F] with zeros up to a multiple of ``CHANNELS``."""
    return [pad(tensor, (0, -tensor.shape[-1] % CHANNELS)) for tensor in tensors]


def _further(saved: Mapping[str, Tensor], wide: tuple[Tensor, Tensor]) -> tuple[list[Tensor], Tensor]:
    """Return the features of ``cuda_passes.backward``, and of them the gradients of the values."""
    values, background = _padded(saved["values"], saved["background"])
    planes = [image.permute(2, 0, 1).contiguous() for image in _padded(*(image[..., 3:] for image in wide))]
    to_values = torch.zeros_like(values)
    return [values, background, *planes, to_values], to_values
