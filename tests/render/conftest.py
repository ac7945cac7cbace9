"""``backend`` runs a test on every rasterizer of this machine; the CUDA kernels also run emulated on the CPU."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import emulate
from fake_backends import altered
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.errors import BackendError
from gs2d.kernels.cuda.launch import Launcher
from gs2d.render.backends import Backend, get_backend
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.types import Features, RasterSettings, RenderOutput


@pytest.fixture
def backend_named(request: pytest.FixtureRequest) -> Callable[[str], Backend]:
    """Return a backend by name; skip with the reason if it cannot run here.

    ``cuda`` accepts and returns tensors in host memory; ``emulated`` runs the same kernels on the CPU.
    """

    def named(name: str) -> Backend:
        if name == "emulated":
            return _emulated(request.getfixturevalue("emulator"))
        found = _available(name)
        return _from_host(found) if name == "cuda" else found

    return named


@pytest.fixture(params=["reference", "cpu", "emulated", pytest.param("cuda", marks=pytest.mark.gpu)])
def backend(request: pytest.FixtureRequest, backend_named: Callable[[str], Backend]) -> Backend:
    """Return each available backend in turn."""
    return backend_named(request.param)


@pytest.fixture
def cpu() -> Backend:
    """Return the native backend, or skip."""
    return _available("cpu")


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def native(request: pytest.FixtureRequest, backend_named: Callable[[str], Backend]) -> Backend:
    """Return a kernel backend for comparison with the reference on many scenes: native, or a real GPU."""
    return backend_named(request.param)


@pytest.fixture(scope="session")
def emulator() -> emulate.Emulator:
    """Return a launcher that runs the CUDA kernels on the CPU."""
    return emulate.Emulator()


def _available(name: str) -> Backend:
    try:
        return get_backend(name)
    except BackendError as error:
        pytest.skip(str(error))


def _emulated(launcher: Launcher) -> Backend:
    return altered(CudaBackend(launcher=launcher), device="cpu")


def _from_host(backend: Backend) -> Backend:
    """Wrap a backend for tensors in host memory: copies them to the device and back, including gradients."""
    device = torch.device(backend.device)

    def there(tensor: Tensor | None) -> Tensor | None:
        return None if tensor is None else tensor.to(device)

    def here(output: RenderOutput) -> RenderOutput:
        return RenderOutput(**{k: t.cpu() for k, t in vars(output).items() if t is not None})

    def rasterize(
        s: Splats, c: Camera, r: RasterSettings, p: Tensor | None = None, rows: Tensor | None = None
    ) -> RenderOutput:
        moved = Splats(**{k: t.to(device) for k, t in s.items()})
        return here(backend.rasterize(moved, c, r, there(p), there(rows)))

    def rasterize_features(
        s: Splats, c: Camera, r: RasterSettings, f: Features, p: Tensor | None = None
    ) -> RenderOutput:
        moved = Features(f.values.to(device), f.background.to(device))
        return here(backend.rasterize_features(s.to(device), c, r, moved, there(p)))

    def splat_errors(
        s: Splats, c: Camera, image: Tensor, r: RasterSettings, mask: Tensor | None = None, occlusion: bool = False
    ) -> Tensor:
        return backend.splat_errors(s.to(device), c, image.to(device), r, there(mask), occlusion).cpu()

    return altered(
        backend,
        device="cpu",
        rasterize=rasterize,
        rasterize_features=rasterize_features,
        splat_errors=splat_errors,
    )
