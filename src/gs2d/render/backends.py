"""Rendering backends: the interface, the registry, and the choice of a backend for this machine.

A backend is one class with everything that differs between processors: rendering, the fused losses, the updates of a
training iteration, and fusion. Code outside ``render`` does not ask which backend it has. "auto" chooses a backend and
reports its name; a backend that is named explicitly is used or fails.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self, TypeGuard, TypeVar

import torch
from torch import Tensor

from gs2d.config.registry import Register, Registry
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.errors import BackendError, ShapeError
from gs2d.kernels import torch_kernels
from gs2d.kernels.adam_update import AdamUpdate
from gs2d.kernels.loss_operations import LossOperations
from gs2d.kernels.tsdf import FusionOnDevice
from gs2d.render.types import Features, RasterSettings, RenderOutput
from gs2d.render.whole_step import WholeStep

if TYPE_CHECKING:
    from gs2d.render.cpu_cached import CachedView

T = TypeVar("T")

BACKENDS: Registry[Callable[[], Backend]] = Registry(
    "backend",
    "gs2d.backends",
    builtin={name: f"gs2d.render.{name}_backend" for name in ("cuda", "cpu", "reference")},  # in the order of "auto"
    error=BackendError,
)
"""Names of backends -> their classes, or functions that return a backend or raise BackendError."""


def register_backend(name: str) -> Callable[[Register], Register]:
    """Return a decorator that registers a rasterizer backend for ``backend=name``.

    Parameters
    ----------
    name : str
        Must not be taken.

    Returns
    -------
    callable
        Decorates a subclass of ``gs2d.render.backends.Backend`` with methods ``rasterize`` and ``splat_errors``. The
        class is called without arguments, and raises BackendError if it cannot run on this machine.

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
    """One line of ``gs2d doctor``."""

    name: str
    available: bool
    reason: str  # why the backend cannot run; "" if it can
    remedy: str  # how to make it available; "" if it can run
    details: str  # instruction set, version, device


class Backend:
    """Base class of backends.

    A backend implements :meth:`rasterize` and :meth:`splat_errors`. All other methods have an implementation in torch
    that a backend may replace. They trust their arguments: :mod:`gs2d.render.api` checks them first.

    Training calls :meth:`iterate`. An iteration changes tensors only by :meth:`adam_step`, :meth:`accumulate` and
    :meth:`assign`. An asynchronous backend may learn later that an image was incomplete: these methods then have
    changed nothing, and the backend repeats the iteration before the next one.
    """

    name: str = ""
    device: str = "cpu"  # for the tensors of training, scoring and meshing
    lowpass_depths: tuple[str, ...] = ("center",)  # supported values of ``RasterSettings.lowpass_depth``
    takes_rays: bool = False  # whether cameras may have rays (rule 25)
    ray_gradients: bool = False  # whether these rays get gradients
    caches_views: bool = False  # whether :meth:`cache_view` is implemented
    slow: bool = False  # whether users who did not choose this backend get a warning
    about: str = ""  # details for ``gs2d doctor``

    @property
    def on_host(self) -> bool:
        """Whether its tensors are in host memory, so that reading them waits for no device."""
        return torch.device(self.device).type == "cpu"

    @classmethod
    def ready(cls) -> Self:
        """Return a backend that can run here; raise BackendError with the reason and the remedy, separated by "; "."""
        return cls()

    # -- rendering ---------------------------------------------------------------------------------------------------
    def rasterize(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None = None,
        gradient_rows: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view; the contract is in :mod:`gs2d.render.api`."""
        raise NotImplementedError(f"backend {self.name!r} does not render")

    def rasterize_features(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        features: Features,
        screen_probe: Tensor | None = None,
    ) -> RenderOutput:
        """Render one view with further channels, without depth by transmittance.

        This implementation renders three channels at a time, and so supports no probe of four columns.
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
        """Return the summed colour error of each splat [N]: rule 17 of the contract."""
        raise NotImplementedError(f"backend {self.name!r} does not compute splat errors")

    def cache_view(
        self, splats: Splats, camera: Camera, settings: RasterSettings, rows: Tensor, *, limit_bytes: int
    ) -> CachedView | None:
        """Cache a view in which only the colours of ``rows`` change; None if it exceeds ``limit_bytes``."""
        raise NotImplementedError(f"backend {self.name!r} caches no views")

    # -- losses and fusion -------------------------------------------------------------------------------------------
    def loss_operations(self, device: torch.device) -> LossOperations | None:
        """Return fused operations for the losses of images on a device; None: torch computes them."""
        return None

    def fusion(self) -> FusionOnDevice | None:
        """Return what fuses depth maps into volumes; None: the native CPU library does."""
        return None

    # -- a training iteration ----------------------------------------------------------------------------------------
    def for_training(self) -> Backend:
        """Return a backend for the iterations of one training, which may keep state between them."""
        return self

    def iterate(self, update: Callable[[], T], *, rollback: Callable[[], None], exact: bool) -> T:
        """Run an iteration; first repeat the previous one if it has changed nothing.

        ``update`` renders, and changes tensors only by methods of this backend. ``rollback`` undoes what ``update`` has
        counted on the host, before ``update`` is repeated. ``exact``: whether the iteration must be complete when this
        method returns, since the caller reads its results.
        """
        return update()

    def takes_whole_steps(self) -> bool:
        """Whether :meth:`step` may run an iteration; if not, callers need not describe one."""
        return False

    def step(self, step: WholeStep) -> bool:
        """Run an iteration with the usual losses in one call; False: it is not supported and nothing was done.

        Images, losses and gradients of such an iteration are not available afterwards.
        """
        return False

    def adam_step(self, updates: Sequence[AdamUpdate], *, beta1: float, beta2: float, eps: float) -> None:
        """Run one Adam step on several attributes, in place."""
        torch_kernels.adam_step(updates, beta1=beta1, beta2=beta2, eps=eps)

    def accumulate(self, signed: Tensor, absolute: Tensor, count: Tensor, signal: Tensor, radii: Tensor) -> None:
        """Add the norms of a densification signal [N, 2 or 4] of the splats with a radius to sums [N], in place.

        It is the gradient of the screen probe: signed in columns 0:2, absolute in 2:4, which ``absolute`` is for.
        """
        torch_kernels.accumulate(signed, absolute, count, signal, radii)

    def assign(self, target: Tensor, value: Tensor) -> None:
        """Copy a value into a tensor."""
        target.copy_(value)

    def is_whole(self) -> bool:
        """Whether the images of this iteration are complete; waits for the device."""
        return True

    def first_not_finite(self, tensors: Sequence[Tensor]) -> int | None:
        """Return the index of the first tensor with a NaN or an infinity, None if all are finite."""
        return torch_kernels.first_not_finite(tensors)

    # -- description -------------------------------------------------------------------------------------------------
    def identity(self) -> dict[str, Any]:
        """Return everything that determines the computed bits: equal facts, equal bits."""
        return {"name": self.name}

    @classmethod
    def status(cls) -> BackendStatus:
        """Return the line for ``gs2d doctor``."""
        try:
            backend = cls.ready()
        except BackendError as error:
            reason, _, remedy = str(error).partition("; ")
            return BackendStatus(cls.name, False, reason, remedy, "")
        return BackendStatus(cls.name, True, "", "", backend.about or cls.__module__)


def get_backend(name: str, device: str | None = None) -> Backend:
    """Return the backend with this name, ready to run.

    Parameters
    ----------
    name : str
        "cpu", "cuda", "reference", a registered name, or "auto": the first of cuda, cpu and reference that this machine
        can run (``.name`` says which; ``backend_report`` says why not another).
    device : str, optional
        Type of the device that holds the tensors. For "auto", "cuda" means the cuda backend or an error, "cpu" the
        native kernels or the reference, any other device the reference.

    Returns
    -------
    Backend

    Raises
    ------
    BackendError
        If the named backend cannot run here, or the name is unknown.
    """
    if name == "auto":
        return _auto(device)
    if name not in BACKENDS:
        raise BackendError(BACKENDS.unknown(name, also=("auto",)))
    make = BACKENDS.get(name)
    return make.ready() if _is_class(make) else make()


def _is_class(make: object) -> TypeGuard[type[Backend]]:
    return isinstance(make, type) and issubclass(make, Backend)


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
        In the order of preference of "auto", then registered ones: ``name``, ``available``, and the ``reason`` and
        ``remedy`` if a backend cannot run.
    """
    return tuple(_status(name, make) for name, make in BACKENDS.working())


def _status(name: str, make: Callable[[], Backend]) -> BackendStatus:
    if not _is_class(make):
        return BackendStatus(name, True, "", "", BACKENDS.source(name))
    return replace(make.status(), name=name)
