"""Structure from motion of a drawn room, run once for all tests; they never change it."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gs2d.cli import run
from room_photos import Room, turn_file, write_room


@pytest.fixture(scope="session")
def colmap() -> None:
    """Skip where pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("no pycolmap: pip install pycolmap")


@pytest.fixture(scope="session")
def room(colmap: None, tmp_path_factory: pytest.TempPathFactory) -> Room:
    """Twelve photographs, of which three are stored turned; one file is no photograph."""
    root = tmp_path_factory.mktemp("sfm")
    cameras = write_room(root / "photos", 12)
    for i, orientation in ((2, 6), (5, 8), (9, 3)):
        turn_file(root / "photos" / f"{i:03}.jpg", orientation)
    (root / "photos" / "notes.txt").write_text("corner, noon")
    out = root / "captures" / "room"  # its folder is made too
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert run(["poses", str(root / "photos"), "--out", str(out), "--json", "--threads", "2"]) == 0
    names = {f"{i:03}.jpg": camera for i, camera in enumerate(cameras)}
    return Room(root / "photos", out, json.loads(printed.getvalue()), names)


@pytest.fixture(scope="session")
def pieces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five photographs of one room, four of another, and one of nothing."""
    root = tmp_path_factory.mktemp("pieces") / "photos"
    write_room(root, 5)
    write_room(root, 4, seed=1, start=10)
    Image.fromarray(np.full((200, 200, 3), 90, np.uint8)).save(root / "blank.jpg")
    return root
