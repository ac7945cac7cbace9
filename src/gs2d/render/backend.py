"""Which rasterizers this machine can run. "auto" is an explicit choice, reported by name; no silent fallback."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from gs2d.camera import Camera
from gs2d.errors import BackendError
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.splats import Splats

__all__ = ["BACKENDS", "Backend", "BackendStatus", "backend_report", "get_backend"]

BACKENDS = ("cpu", "cuda", "reference")

NO_CUDA = "this version has no CUDA backend yet"


class _Rasterize(Protocol):
    def __call__(
        self, splats: Splats, camera: Camera, settings: RasterSettings, screen_probe: Tensor | None = None
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
    """A rasterizer by name. Its functions trust their arguments: :mod:`gs2d.render.api` checks them first."""

    name: str
    rasterize: _Rasterize
    splat_errors: _SplatErrors


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

    return Backend("cpu", cpu.rasterize, cpu.splat_errors)


def _cuda() -> Backend:
    raise BackendError(f"backend 'cuda' cannot run: {NO_CUDA}; use --backend cpu")


_LOADERS: dict[str, Callable[[], Backend]] = {"cpu": _cpu, "cuda": _cuda, "reference": _reference}


def get_backend(name: str) -> Backend:
    """The backend of this name, ready to run.

    Parameters
    ----------
    name : str
        "auto" (the native CPU kernels if their library loads, else the reference: ``.name`` says which), "cpu",
        "cuda" or "reference".

    Raises
    ------
    BackendError
        If a backend asked for by name cannot run here, or the name is unknown.
    """
    if name == "auto":
        try:
            return _cpu()
        except BackendError:
            return _reference()
    if name not in _LOADERS:
        raise BackendError(f"backend must be one of auto, {', '.join(BACKENDS)}, got {name!r}")
    return _LOADERS[name]()


def backend_report() -> tuple[BackendStatus, ...]:
    """What this machine can run and why not, in the order of preference."""
    from gs2d.kernels.library import REMEDY, available_variants, prepare

    try:
        library = prepare()
        details = f"{library.instruction_set}; {library.threads} threads; built: {', '.join(available_variants())}"
        cpu = BackendStatus("cpu", True, "", "", details)
    except BackendError as error:
        cpu = BackendStatus("cpu", False, str(error).partition(";")[0], REMEDY, "")
    cuda = BackendStatus("cuda", False, NO_CUDA, "nothing yet: kernels are there, a launcher is not", "")
    reference = BackendStatus("reference", True, "", "", "plain torch, slow; float32 and float64, any device")
    return cpu, cuda, reference
