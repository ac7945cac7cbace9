"""Structure from motion of a rendered room, run once; tests must not modify the results."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from room_photos import Room, found_room, write_room


@pytest.fixture(scope="session")
def colmap() -> None:
    """Skip if pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("no pycolmap: pip install pycolmap")


@pytest.fixture(scope="session")
def pycolmap(colmap: None) -> Any:
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    return pycolmap


@pytest.fixture(scope="session")
def room(colmap: None, tmp_path_factory: pytest.TempPathFactory) -> Room:
    """Return twelve images, three of them stored rotated; one file is not an image."""
    return found_room(tmp_path_factory.mktemp("sfm"))


@pytest.fixture(scope="session")
def pieces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return five images of one room, four of another, and one of nothing."""
    root = tmp_path_factory.mktemp("pieces") / "photos"
    write_room(root, 5)
    write_room(root, 4, seed=1, start=10)
    Image.fromarray(np.full((200, 200, 3), 90, np.uint8)).save(root / "blank.jpg")
    return root
