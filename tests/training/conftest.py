"""Fixtures for the trainer."""

from __future__ import annotations

import pytest

from gs2d.data.scene import Scene
from train_toys import backends, make_scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return make_scene()


@pytest.fixture(params=["reference", "cpu"])
def backend(request: pytest.FixtureRequest) -> str:
    if request.param not in backends():
        pytest.skip("the native library is not built")
    return str(request.param)
