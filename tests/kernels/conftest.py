"""Fixtures of the kernel tests: every library this machine can run, and the CUDA emulator."""

from __future__ import annotations

import pytest

import emulate
from gs2d.errors import BackendError
from gs2d.kernels.library import Library, available_variants, load


@pytest.fixture(params=["v4", "v3", "portable"])
def native(request: pytest.FixtureRequest) -> Library:
    """Return each float32 library that this processor can run, with two threads."""
    if request.param not in available_variants():
        pytest.skip(f"this machine cannot run variant {request.param}, or the native library was not built")
    library = load(request.param)
    library.use_threads(2)
    return library


@pytest.fixture
def native64() -> Library:
    """Return the float64 build of the same sources."""
    try:
        library = load("f64")
    except BackendError as error:
        pytest.skip(str(error))
    library.use_threads(2)
    return library


@pytest.fixture(params=["v4", "v3", "portable", "f64"])
def any_native(request: pytest.FixtureRequest) -> Library:
    """Return each library, including the float64 one."""
    if request.param not in (*available_variants(), "f64"):
        pytest.skip(f"this machine cannot run variant {request.param}")
    try:
        library = load(request.param)
    except BackendError as error:
        pytest.skip(str(error))
    library.use_threads(2)
    return library


@pytest.fixture(scope="session")
def emulator() -> emulate.Emulator:
    """Return a launcher that runs the package's CUDA kernels on the CPU."""
    return emulate.Emulator()
