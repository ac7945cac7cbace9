"""Tests that need an NVIDIA GPU: all are marked ``gpu``, and skip with the reason if the backend cannot run."""

from __future__ import annotations

import pytest

from gs2d.errors import BackendError
from gs2d.render.backends import Backend, get_backend


@pytest.fixture(scope="session")
def gpu() -> Backend:
    """Return the cuda backend, or skip."""
    try:
        return get_backend("cuda")
    except BackendError as error:
        pytest.skip(str(error))
