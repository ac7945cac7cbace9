"""The cuda backend: the CUDA kernels on NVIDIA GPUs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Self, TypeVar

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.kernels import torch_kernels
from gs2d.kernels.cuda import cuda_adam, diagnose, launch
from gs2d.kernels.cuda.cuda_losses import CudaLosses
from gs2d.kernels.native_adam import AdamUpdate
from gs2d.kernels.tsdf import FusionOnDevice
from gs2d.render.backends import Backend, register_backend
from gs2d.render.cuda_rasterizer import CudaChoices, rasterize_with, splat_errors_with
from gs2d.render.cuda_step import Stepper
from gs2d.render.pair_budget import PairBudget
from gs2d.render.types import Features, RasterSettings, RenderOutput
from gs2d.render.whole_step import WholeStep

__all__ = ["CudaBackend"]

T = TypeVar("T")


@register_backend("cuda")
class CudaBackend(Backend):
    """The CUDA kernels.

    Training does not wait for the device: instead of reading the number of pairs of splat and tile, a rendering
    reserves memory for a quarter more than the largest number so far (:class:`PairBudget`). An iteration that needed
    more changes nothing and is repeated.

    Parameters
    ----------
    budget : PairBudget, optional
        None: each rendering waits for its number of pairs.
    """

    name = "cuda"
    device = "cuda"

    def __init__(self, budget: PairBudget | None = None) -> None:
        self._budget = budget
        self._last: tuple[Callable[[], Any], Callable[[], None]] | None = None  # the iteration that may be repeated
        self._stepper: Stepper | None = None

    @classmethod
    def ready(cls) -> Self:
        """Return the backend, or raise BackendError with the first thing that this machine lacks."""
        ready = cls()
        ready.about = _machine()
        return ready

    def rasterize(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None = None,
        gradient_rows: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view on the device of the splats."""
        view = (splats, camera, settings, screen_probe, gradient_rows)
        return rasterize_with(launch.launcher_for(splats.device), *view, choices=CudaChoices(budget=self._budget))

    def rasterize_features(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        features: Features,
        screen_probe: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view with further channels."""
        launcher, choices = launch.launcher_for(splats.device), CudaChoices(budget=self._budget)
        return rasterize_with(launcher, splats, camera, settings, screen_probe, features=features, choices=choices)

    def splat_errors(
        self,
        splats: Splats,
        camera: Camera,
        image: Tensor,
        settings: RasterSettings,
        mask: Tensor | None = None,
        occlusion: bool = False,
    ) -> Tensor:
        """Return the summed colour error of each splat [N]."""
        launcher = launch.launcher_for(splats.device)
        return splat_errors_with(launcher, splats, camera, image, settings, mask, occlusion)

    def loss_operations(self, device: torch.device) -> CudaLosses:
        """Return the fused operations for the losses; caching the local mean of a target would save no time."""
        return CudaLosses(launch.launcher_for(device))

    def fusion(self) -> FusionOnDevice:
        """Return what fuses depth maps into volumes."""
        device = torch.device(self.device)
        return FusionOnDevice(launch.launcher_for(device), device)

    def for_training(self) -> CudaBackend:
        """Return a backend with a budget; torch's memory segments may grow from now on."""
        launch.grow_in_place()
        return type(self)(PairBudget())

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
            self._stepper = Stepper(launch.launcher_for(device), device)
        return self._stepper.run(step, self._budget)

    def _overflow(self) -> Tensor | None:
        """Return whether a rendering of this iteration lacks pairs, [] int32 on the device; None: none can."""
        return None if self._budget is None else self._budget.overflow

    def adam_step(self, updates: Sequence[AdamUpdate], *, beta1: float, beta2: float, eps: float) -> None:
        """Run one Adam step on several attributes in one launch."""
        if not updates:
            return
        launcher = launch.launcher_for(updates[0].parameter.device)
        betas = {"beta1": beta1, "beta2": beta2, "eps": eps}
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
