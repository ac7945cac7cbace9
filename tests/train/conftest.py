"""Fixtures for the trainer."""

from __future__ import annotations

import pytest
from train_toys import make_scene

from gs2d.data.scene import Scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return make_scene()
