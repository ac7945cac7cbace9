"""Which rasterizers this machine can run. "auto" is an explicit choice, reported by name; no silent fallback."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Protocol

from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.errors import BackendError
from gs2d.render.types import RasterSettings, RenderOutput

__all__ = ["BACKENDS", "Backend", "BackendStatus", "backend_report", "get_backend"]

BACKENDS = ("cpu", "cuda", "reference")


class _Rasterize(Protocol):
    def __call__(
        self, splats: Splats, camera: Camera, settings: RasterSettings, screen_probe: Tensor | None = None
    ) -> RenderOutput: ...


class _RasterizeRows(Protocol):
    def __call__(
        self,
        splats: Splats,
        camera: Camera,
        settings: RasterSettings,
        screen_probe: Tensor | None,
        gradient_rows: Tensor | None,
    ) -> RenderOutput: ...


class _SplatErrors(Protocol):
    def __call__(
        self,
        splats: Splats,
        camera: Camera,
        image: Tensor,
        settings: RasterSettings,
        mask: Tensor | None = None,
        occlusion: bool = False,
    ) -> Tensor: ...


@dataclass(frozen=True)
class Backend:
    """A rasterizer by name. Its functions trust their arguments: :mod:`gs2d.render.api` checks them first.

    Attributes
    ----------
    name : str
    rasterize, splat_errors : callable
    device : str
        Where a program that has no tensors yet should make them: training, scoring and meshing do.
    rasterize_rows : callable, optional
        ``rasterize`` with gradients of some rows only, where that saves work; without it render/api.py masks them.
    """

    name: str
    rasterize: _Rasterize
    splat_errors: _SplatErrors
    device: str = "cpu"
    rasterize_rows: _RasterizeRows | None = None


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


def _reference() -> Backend:
    from gs2d.render import reference, reference_errors

    return Backend("reference", reference.rasterize, reference_errors.splat_errors)


def _cpu() -> Backend:
    from gs2d.kernels.library import load

    load()  # BackendError with the reason and the remedy if it is not there or does not load
    from gs2d.render import cpu

    return Backend("cpu", cpu.rasterize, cpu.splat_errors, rasterize_rows=cpu.rasterize)


@cache  # a machine that can run it is asked once, not at each rendering; an error is not kept
def _cuda() -> Backend:
    from gs2d.kernels.cuda.diagnose import gather, missing
    from gs2d.render import cuda

    lacking = missing(gather())
    if lacking is not None:
        raise BackendError(f"backend 'cuda' cannot run: {lacking.reason}; {lacking.remedy}")
    return Backend("cuda", cuda.rasterize, cuda.splat_errors, rasterize_rows=cuda.rasterize, device="cuda")


_LOADERS: dict[str, Callable[[], Backend]] = {"cpu": _cpu, "cuda": _cuda, "reference": _reference}


def get_backend(name: str, device: str | None = None) -> Backend:
    """The backend of this name, ready to run.

    Parameters
    ----------
    name : str
        "cpu", "cuda", "reference", or "auto": the fastest that this machine can run, in the order cuda, cpu, reference
        (``.name`` says which; ``backend_report`` why not another).
    device : str, optional
        Type of the device on which the tensors already lie. It decides for "auto": "cuda" is the cuda backend or an
        error, "cpu" the native kernels or the reference, any other the reference.

    Raises
    ------
    BackendError
        If a backend asked for by name cannot run here, or the name is unknown.
    """
    if name == "auto":
        return _auto(device)
    if name not in _LOADERS:
        raise BackendError(f"backend must be one of auto, {', '.join(BACKENDS)}, got {name!r}")
    return _LOADERS[name]()


def _auto(device: str | None) -> Backend:
    if device == "cuda":
        return _cuda()
    for load in {None: (_cuda, _cpu), "cpu": (_cpu,)}.get(device, ()):
        try:
            return load()
        except BackendError:
            continue
    return _reference()


def backend_report() -> tuple[BackendStatus, ...]:
    """What this machine can run and why not, in the order in which "auto" prefers it."""
    from gs2d.kernels.cuda import diagnose
    from gs2d.kernels.library import REMEDY, available_variants, ready_library

    try:
        library = ready_library()
        details = f"{library.instruction_set}; {library.threads} threads; built: {', '.join(available_variants())}"
        cpu = BackendStatus("cpu", True, "", "", details)
    except BackendError as error:
        cpu = BackendStatus("cpu", False, str(error).partition(";")[0], REMEDY, "")
    facts = diagnose.gather()
    lacking = diagnose.missing(facts)
    if lacking is None:
        cuda = BackendStatus("cuda", True, "", "", diagnose.describe(facts))
    else:
        cuda = BackendStatus("cuda", False, lacking.reason, lacking.remedy, "")
    reference = BackendStatus("reference", True, "", "", "plain torch, slow; float32 and float64, any device")
    return cuda, cpu, reference
