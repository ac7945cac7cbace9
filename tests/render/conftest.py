"""``backend`` runs a test on every rasterizer that this machine has."""

from __future__ import annotations

import pytest

from gs2d.errors import BackendError
from gs2d.render.backend import Backend, get_backend


@pytest.fixture(params=["reference", "cpu"])
def backend(request: pytest.FixtureRequest) -> Backend:
    """Every available backend; the ones that cannot run here skip with their reason."""
    return _available(request.param)


@pytest.fixture
def cpu() -> Backend:
    """The native backend, or skip."""
    return _available("cpu")


def _available(name: str) -> Backend:
    try:
        return get_backend(name)
    except BackendError as error:
        pytest.skip(str(error))
