"""Tests that need an NVIDIA GPU: all are marked ``gpu``, and skip with the reason where the backend cannot run."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from gs2d.errors import BackendError
from gs2d.render.backend import Backend, get_backend

for folder in ("render", "train", "cuda"):  # render_scenes, train_toys, emulate
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / folder))


@pytest.fixture(scope="session")
def gpu() -> Backend:
    """The cuda backend, or skip."""
    try:
        return get_backend("cuda")
    except BackendError as error:
        pytest.skip(str(error))
