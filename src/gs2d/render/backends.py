"""What a backend is, and which of them this machine can run. "auto" is a choice, reported by name; nothing falls back.

A backend is one class. All that differs between processors is in it: rendering, the fused losses, the updates of a
training iteration, fusion. So nothing outside of this room asks which one it has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from gs2d.config.registry import Register, Registry
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.errors import BackendError, ShapeError
from gs2d.kernels import densify_stats, library
from gs2d.kernels import native_adam as adam
from gs2d.kernels import native_losses as losses
from gs2d.kernels import native_multiview as multiview
from gs2d.kernels import torch_kernels as reference
from gs2d.kernels.cuda import cuda_adam, cuda_losses, cuda_multiview, diagnose, launch
from gs2d.kernels.native_losses import LossOperations
from gs2d.kernels.tsdf import FusionOnDevice, FusionOnHost
from gs2d.render import cpu_backend as cpu
from gs2d.render import cpu_cached, reference_errors, reference_rasterizer
from gs2d.render import cuda_backend as cuda
from gs2d.render.cpu_cached import CachedView
from gs2d.render.cuda_step import Stepper
from gs2d.render.pair_budget import PairBudget
from gs2d.render.types import Features, RasterSettings, RenderOutput
from gs2d.render.whole_step import WholeStep

__all__ = [
    "BACKENDS",
    "PLAIN",
    "Backend",
    "BackendStatus",
    "CpuBackend",
    "CudaBackend",
    "ReferenceBackend",
    "backend_report",
    "get_backend",
    "register_backend",
]

T = TypeVar("T")

BACKENDS: Registry[Callable[[], Backend]] = Registry(
    "backend", "gs2d.backends", builtin=dict.fromkeys(("cpu", "cuda", "reference"), __name__), error=BackendError
)
"""Names of backends -> what makes one ready to run, or raises BackendError: its class."""


def register_backend(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers a rasterizer backend, so that ``backend=name`` can be given.

    Parameters
    ----------
    name : str
        Must not be taken.

    Returns
    -------
    callable
        Decorates a subclass of ``gs2d.render.backends.Backend`` with methods ``rasterize`` and ``splat_errors``. It is
        called without arguments, and raises BackendError where it cannot run.

    Raises
    ------
    BackendError
        From the decorator: the name is taken.

    Examples
    --------
    The guide "Extending gs2d" has a whole backend.

    >>> @gs2d.register_backend("checked")  # doctest: +SKIP
    ... class Checked(CpuBackend):
    ...     name = "checked"
    >>> output = gs2d.rasterize(splats, camera, backend="checked")  # doctest: +SKIP
    """
    return BACKENDS.register(name)


@dataclass(frozen=True)
class BackendStatus:
    """One line of ``gs2d doctor``.

    Attributes
    ----------
    name : str
    available : bool
    reason : str
        Why it cannot run; "" where it can.
    remedy : str
        What to do about it; "" where it can run.
    details : str
        What would run: instruction set, version, device.
    """

    name: str
    available: bool
    reason: str
    remedy: str
    details: str


class Backend:
    """One way to render, to compare and to learn.

    A backend implements :meth:`rasterize` and :meth:`splat_errors`; all the rest is there in plain torch, and may be
    done better. Its functions trust their arguments: :mod:`gs2d.render.api` checks them first.

    A training goes by :meth:`iterate`. What changes in an iteration is changed by :meth:`adam_step`,
    :meth:`accumulate` and :meth:`assign`: a backend that does not wait for its device may find afterwards that an
    image was not whole. It then has changed nothing by these, and does the iteration again before the next.

    Attributes
    ----------
    name : str
    device : str
        Where a program that has no tensors yet should make them: training, scoring and meshing do.
    lowpass_depths : tuple of str
        The values of ``RasterSettings.lowpass_depth`` that it can render with.
    caches_views : bool
        Whether :meth:`cache_view` is there.
    slow : bool
        Whether one says so to people who did not ask for it by name.
    about : str
        What ``gs2d doctor`` says of it where it can run.
    """

    name: str = ""
    device: str = "cpu"
    lowpass_depths: tuple[str, ...] = ("center",)
    caches_views: bool = False
    slow: bool = False
    about: str = ""

    @property
    def on_host(self) -> bool:
        """Whether its tensors lie in the memory of the CPU, so that nothing waits for another device."""
        return torch.device(self.device).type == "cpu"

    # -- rendering ---------------------------------------------------------------------------------------------------
    def rasterize(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None = None,
        gradient_rows: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view: the contract is in :mod:`gs2d.render.api`."""
        raise NotImplementedError(f"backend {self.name!r} does not render")

    def rasterize_features(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        features: Features,
        screen_probe: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view with further channels; here each three of them are a rendering of their own.

        Without depth by transmittance.

        Raises
        ------
        ShapeError
            If the probe has four columns: absolute values cannot be summed in parts.
        """
        if screen_probe is not None and screen_probe.shape[1] == 4:
            raise ShapeError(
                f"screen_probe must have 2 columns for more than 3 channels on backend {self.name!r}, got 4: it "
                "renders three channels at a time, and absolute values cannot be summed in parts"
            )
        first = self.rasterize(splats, camera, settings, screen_probe)
        count = features.values.shape[1]
        padded = torch.nn.functional.pad(features.values, (0, -count % 3))
        behind = [*features.background.tolist(), 0.0, 0.0]
        images = [first.color]
        for start in range(0, count, 3):
            red, green, blue = behind[start : start + 3]
            part = replace(splats, sh0=padded[:, None, start : start + 3])
            of_part = replace(settings, background=(red, green, blue), with_distortion=False)
            images.append(self.rasterize(part, camera, of_part, screen_probe).color)
        return replace(first, color=torch.cat(images, dim=2)[..., : 3 + count])

    def splat_errors(
        self,
        splats: Splats,
        camera: Camera,
        image: Tensor,
        settings: RasterSettings,
        mask: Tensor | None = None,
        occlusion: bool = False,
    ) -> Tensor:
        """Sum the colour errors of each splat [N]: rule 17 of the contract."""
        raise NotImplementedError(f"backend {self.name!r} does not rank")

    def cache_view(
        self, splats: Splats, camera: Camera, settings: RasterSettings, rows: Tensor, *, limit_bytes: int
    ) -> CachedView | None:
        """Keep a view of which only the colours of ``rows`` change (:mod:`gs2d.render.cpu_cached`)."""
        raise NotImplementedError(f"backend {self.name!r} caches no views")

    # -- losses and fusion -------------------------------------------------------------------------------------------
    def loss_operations(self, device: torch.device) -> LossOperations | None:
        """Fused operations for the losses of images on a device; None: they are worked out in torch."""
        return None

    def fusion(self) -> FusionOnHost | FusionOnDevice | None:
        """Return what adds depth maps to volumes; None: numpy does."""
        return None

    # -- a training iteration ----------------------------------------------------------------------------------------
    def for_training(self) -> Backend:
        """Return the backend for the iterations of one training, with what it remembers from one to the next."""
        return self

    def iterate(self, update: Callable[[], T], *, rollback: Callable[[], None], exact: bool) -> T:
        """Run an iteration, and before it the one before again where that has changed nothing.

        Parameters
        ----------
        update : callable
            Renders, and changes tensors by the functions of this backend alone.
        rollback : callable
            Takes back what the host has counted in ``update``, which is then called again.
        exact : bool
            The caller looks at the device after this iteration anyway: it must be whole when this returns.
        """
        return update()

    def takes_whole_steps(self) -> bool:
        """Whether :meth:`step` may do an iteration at all: else nobody needs to describe one."""
        return False

    def step(self, step: WholeStep) -> bool:
        """Do an iteration with the usual losses in one piece; False: not this one, and nothing was done.

        Its images, losses and gradients are not to be had afterwards: who wants to look does the parts.
        """
        return False

    def adam_step(self, updates: Sequence[adam.AdamUpdate], *, beta1: float, beta2: float, eps: float) -> None:
        """One Adam step of some attributes, in place."""
        reference.adam_step(updates, beta1=beta1, beta2=beta2, eps=eps)

    def accumulate(self, signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor) -> None:
        """Add the norms of a densification signal [N, 2 or 4] of the splats with a radius, in place."""
        reference.accumulate(signed, absolute, count, signal, radii)

    def assign(self, target: Tensor, value: Tensor) -> None:
        """Give a tensor new values, in place."""
        target.copy_(value)

    def is_whole(self) -> bool:
        """Whether the images of this iteration are whole; the host waits for the device to know."""
        return True

    def first_not_finite(self, tensors: Sequence[Tensor]) -> int | None:
        """Return the number of the first tensor with a NaN or an infinity, None if all are finite."""
        return reference.first_not_finite(tensors)

    # -- what it is --------------------------------------------------------------------------------------------------
    def facts(self) -> dict[str, Any]:
        """Return all that decides the bytes that are computed here: equal facts, equal bytes."""
        return {"name": self.name}

    @classmethod
    def status(cls) -> BackendStatus:
        """Return what ``gs2d doctor`` says of it."""
        try:
            made = cls()
        except BackendError as error:
            reason, _, remedy = str(error).partition("; ")
            return BackendStatus(cls.name, False, reason, remedy, "")
        return BackendStatus(cls.name, True, "", "", made.about or cls.__module__)


@register_backend("reference")
class ReferenceBackend(Backend):
    """Plain torch: the judge of the others."""

    name = "reference"
    about = "plain torch, slow; float32 and float64, any device"
    lowpass_depths = ("center", "plane")
    slow = True

    def rasterize(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None = None,
        gradient_rows: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view."""
        if gradient_rows is not None:
            splats = Splats(**{name: _only_rows(tensor, gradient_rows) for name, tensor in splats.items()})
            screen_probe = None if screen_probe is None else _only_rows(screen_probe, gradient_rows)
        return reference_rasterizer.rasterize(splats, camera, settings, screen_probe)

    def rasterize_features(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        features: Features,
        screen_probe: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view with further channels."""
        return reference_rasterizer.rasterize(splats, camera, settings, screen_probe, features)

    def splat_errors(
        self,
        splats: Splats,
        camera: Camera,
        image: Tensor,
        settings: RasterSettings,
        mask: Tensor | None = None,
        occlusion: bool = False,
    ) -> Tensor:
        """Sum the colour errors of each splat [N]."""
        return reference_errors.splat_errors(splats, camera, image, settings, mask, occlusion)


def _only_rows(tensor: Tensor, rows: Tensor) -> Tensor:
    """Return the same values; gradients reach only these rows."""
    shape = (-1, *[1] * (tensor.dim() - 1))
    return torch.where(rows.reshape(shape), tensor, tensor.detach()) if tensor.requires_grad else tensor


PLAIN = ReferenceBackend()


@register_backend("cpu")
class CpuBackend(Backend):
    """The native library: SIMD and threads; float32.

    Raises
    ------
    BackendError
        If it was not built, or does not load.
    """

    name = "cpu"
    caches_views = True

    def __init__(self) -> None:
        library.load()

    def rasterize(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None = None,
        gradient_rows: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view; the work for gradients that are not wanted is saved."""
        return cpu.rasterize(splats, camera, settings, screen_probe, gradient_rows)

    def rasterize_features(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        features: Features,
        screen_probe: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view with further channels."""
        return cpu.rasterize(splats, camera, settings, screen_probe, features=features)

    def splat_errors(
        self,
        splats: Splats,
        camera: Camera,
        image: Tensor,
        settings: RasterSettings,
        mask: Tensor | None = None,
        occlusion: bool = False,
    ) -> Tensor:
        """Sum the colour errors of each splat [N]."""
        return cpu.splat_errors(splats, camera, image, settings, mask, occlusion)

    def cache_view(
        self, splats: Splats, camera: Camera, settings: RasterSettings, rows: Tensor, *, limit_bytes: int
    ) -> CachedView | None:
        """Keep a view of which only the colours of ``rows`` change; None where it takes more than ``limit_bytes``."""
        return cpu_cached.cache_view(splats, camera, settings, rows, limit_bytes=limit_bytes)

    def loss_operations(self, device: torch.device) -> LossOperations:
        """Fused operations for the losses."""
        return LossOperations(
            losses.photometric, losses.normal_consistency, losses.masked_mean, losses.blur, multiview.compare_views
        )

    def fusion(self) -> FusionOnHost:
        """Return what adds depth maps to volumes."""
        return FusionOnHost(library.load())

    def adam_step(self, updates: Sequence[adam.AdamUpdate], *, beta1: float, beta2: float, eps: float) -> None:
        """One Adam step of some attributes in one call."""
        adam.adam_step(updates, beta1=beta1, beta2=beta2, eps=eps)

    def accumulate(self, signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor) -> None:
        """Add a densification signal in one pass, the same to rounding."""
        densify_stats.accumulate(signed, absolute, count, signal, radii)

    def first_not_finite(self, tensors: Sequence[Tensor]) -> int | None:
        """In one native call: a tenth of the time of six sums."""
        return adam.first_not_finite(tensors)

    def facts(self) -> dict[str, Any]:
        """Return its name, instruction set and version."""
        native = library.load()
        return {"name": self.name, "instruction_set": native.instruction_set, "kernels": library.RESULTS_VERSION}

    @classmethod
    def status(cls) -> BackendStatus:
        """Return what ``gs2d doctor`` says of it."""
        try:
            native = library.ready_library()
        except BackendError as error:
            return BackendStatus(cls.name, False, str(error).partition(";")[0], library.REMEDY, "")
        built = ", ".join(library.available_variants())
        return BackendStatus(
            cls.name, True, "", "", f"{native.instruction_set}; {native.threads} threads; built: {built}"
        )


class CudaBackend(Backend):
    """The CUDA kernels.

    In training they wait for nothing: the number of pairs of splat and tile is not asked for, room is made for a
    quarter more than ever (:class:`PairBudget`). An iteration whose pairs had no room changes nothing and is done
    again.

    Parameters
    ----------
    budget : PairBudget, optional
        None: each rendering waits for the number of its pairs.
    """

    name = "cuda"
    device = "cuda"

    def __init__(self, budget: PairBudget | None = None) -> None:
        self._budget = budget
        self._last: tuple[Callable[[], Any], Callable[[], None]] | None = None  # what may have to be done again
        self._stepper: Stepper | None = None

    def rasterize(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None = None,
        gradient_rows: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view on the device of the splats."""
        return cuda.rasterize(splats, camera, settings, screen_probe, gradient_rows, budget=self._budget)

    def rasterize_features(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        features: Features,
        screen_probe: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view with further channels."""
        return cuda.rasterize(splats, camera, settings, screen_probe, budget=self._budget, features=features)

    def splat_errors(
        self,
        splats: Splats,
        camera: Camera,
        image: Tensor,
        settings: RasterSettings,
        mask: Tensor | None = None,
        occlusion: bool = False,
    ) -> Tensor:
        """Sum the colour errors of each splat [N]."""
        return cuda.splat_errors(splats, camera, image, settings, mask, occlusion)

    def loss_operations(self, device: torch.device) -> LossOperations:
        """Fused operations for the losses; the local mean of a target is as fast made as fetched."""
        launcher = launch.launcher_for(device)
        return LossOperations(
            partial(cuda_losses.photometric, launcher=launcher),
            partial(cuda_losses.normal_consistency, launcher=launcher),
            partial(cuda_losses.masked_mean, launcher=launcher),
            compare_views=partial(cuda_multiview.compare_views, launcher=launcher),
        )

    def fusion(self) -> FusionOnDevice:
        """Return what adds depth maps to volumes."""
        device = torch.device(self.device)
        return FusionOnDevice(launch.launcher_for(device), device)

    def for_training(self) -> CudaBackend:
        """Return one with a budget; torch's memory grows with the splats from here on."""
        launch.grow_in_place()
        return type(self)(PairBudget())

    def iterate(self, update: Callable[[], T], *, rollback: Callable[[], None], exact: bool) -> T:
        """Run an iteration, and before it the one before again where that lacked pairs."""
        budget = self._budget
        if budget is None:
            return update()
        if self._last is not None and budget.overflowed():
            again, take_back = self._last
            take_back()
            budget.exact = True
            again()
        budget.exact = exact
        self._last = update, rollback
        return update()

    def takes_whole_steps(self) -> bool:
        """In a training, in an iteration after which nobody looks at the device."""
        budget = self._budget
        if budget is None:
            return False
        if budget.exact and self._stepper is not None:
            self._stepper.release()
        return not budget.exact and not torch.are_deterministic_algorithms_enabled()

    def step(self, step: WholeStep) -> bool:
        """Do an iteration by kernels alone (:mod:`gs2d.render.cuda_step`)."""
        if self._budget is None or not self.takes_whole_steps():
            return False
        if self._stepper is None:
            launch.steps()  # an unknown value is refused before anything is done
            device = step.splats.device
            self._stepper = Stepper(launch.launcher_for(device), device)
        return self._stepper.run(step, self._budget)

    def _overflow(self) -> Tensor | None:
        """[] int32 on the device: whether a rendering of this iteration lacks pairs; None: none can."""
        return None if self._budget is None else self._budget.overflow

    def adam_step(self, updates: Sequence[adam.AdamUpdate], *, beta1: float, beta2: float, eps: float) -> None:
        """One Adam step of some attributes in one launch."""
        if not updates:
            return
        launcher = launch.launcher_for(updates[0].parameter.device)
        settings = {"beta1": beta1, "beta2": beta2, "eps": eps}
        cuda_adam.adam_step(updates, **settings, launcher=launcher, skip=self._overflow())

    def accumulate(self, signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor) -> None:
        """Add a densification signal."""
        overflow = self._overflow()
        seen = radii if overflow is None else radii * (1 - overflow)
        reference.accumulate(signed, absolute, count, signal, seen)

    def assign(self, target: Tensor, value: Tensor) -> None:
        """Give a tensor new values, in place."""
        overflow = self._overflow()
        target.copy_(value if overflow is None else torch.where(overflow != 0, target, value))

    def is_whole(self) -> bool:
        """Whether the images of this iteration are whole; the host waits for the device to know."""
        overflow = self._overflow()
        return overflow is None or int(overflow) == 0

    @classmethod
    def status(cls) -> BackendStatus:
        """Return what ``gs2d doctor`` says of it."""
        lacking, words = diagnose.report()
        if lacking is None:
            return BackendStatus(cls.name, True, "", "", words)
        return BackendStatus(cls.name, False, lacking.reason, lacking.remedy, "")


@register_backend("cuda")
@cache  # a machine that can run it is asked once, not at each rendering; an error is not kept
def _cuda() -> Backend:
    lacking, _ = diagnose.report()
    if lacking is not None:
        raise BackendError(f"backend 'cuda' cannot run: {lacking.reason}; {lacking.remedy}")
    return CudaBackend()


def get_backend(name: str, device: str | None = None) -> Backend:
    """Return the backend of this name, ready to run.

    Parameters
    ----------
    name : str
        "cpu", "cuda", "reference", one that a package or a program has registered, or "auto": the fastest of the three
        that this machine can run, in the order cuda, cpu, reference (``.name`` says which; ``backend_report`` why not
        another).
    device : str, optional
        Type of the device on which the tensors already lie. It decides for "auto": "cuda" is the cuda backend or an
        error, "cpu" the native kernels or the reference, any other the reference.

    Returns
    -------
    Backend

    Raises
    ------
    BackendError
        If a backend asked for by name cannot run here, or the name is unknown.
    """
    if name == "auto":
        return _auto(device)
    if name not in BACKENDS:
        raise BackendError(BACKENDS.unknown(name, also=("auto",)))
    made = BACKENDS.get(name)()
    return made


def _auto(device: str | None) -> Backend:
    if device == "cuda":
        return get_backend("cuda")
    for name in {None: ("cuda", "cpu"), "cpu": ("cpu",)}.get(device, ()):
        try:
            return get_backend(name)
        except BackendError:
            continue
    return get_backend("reference")


def backend_report() -> tuple[BackendStatus, ...]:
    """Report which backends this machine can run.

    Returns
    -------
    tuple of BackendStatus
        In the order in which "auto" prefers them, then registered ones: ``name``, ``available``, and the ``reason`` and
        ``remedy`` where a backend cannot run.
    """
    own = (CudaBackend.status(), CpuBackend.status(), ReferenceBackend.status())
    guests = (_status(name, make) for name, make in BACKENDS.working() if name not in BACKENDS.builtin)
    return (*own, *guests)


def _status(name: str, make: Callable[[], Backend]) -> BackendStatus:
    """Return what a backend from elsewhere says of itself."""
    status = make.status() if isinstance(make, type) and issubclass(make, Backend) else None
    if status is None:
        return BackendStatus(name, True, "", "", BACKENDS.source(name))
    return BackendStatus(name, status.available, status.reason, status.remedy, status.details)
