"""Synthetic images of a room corner with textured walls, for structure-from-motion tests."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from gs2d.cli import run
from gs2d.core.camera import Camera, look_at

SIZE, FOCAL = 200, 203.0  # px
UP = np.array([0.0, 0.0, 1.0])
STORED = {
    3: Image.Transpose.ROTATE_180,
    6: Image.Transpose.ROTATE_90,
    8: Image.Transpose.ROTATE_270,
}  # EXIF orientation -> transposition to store
_CELLS = 512  # cells per texture, over 4 world units


def textures(seed: int = 0) -> np.ndarray:
    """Return multi-scale noise [3, _CELLS, _CELLS, 3] in [0, 255], with unique corner features everywhere."""
    rng = np.random.default_rng(seed)
    out = np.zeros((3, _CELLS, _CELLS, 3))
    for cells, weight in ((16, 1.0), (32, 1.2), (64, 1.0)):
        noise = rng.random((3, cells, cells, 3)).repeat(_CELLS // cells, axis=1).repeat(_CELLS // cells, axis=2)
        out += weight * noise
    return np.asarray(255 * (out - out.min()) / (out.max() - out.min()))


def room_image(camera: Camera, walls: np.ndarray) -> np.ndarray:
    """Render the octant x, y, z > 0 as uint8 [H, W, 3]: floor z = 0, walls x = 0 and y = 0, each with a texture."""
    samples = 2  # per pixel side
    rows, columns = (np.mgrid[: camera.height * samples, : camera.width * samples] + 0.5) / samples
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)
    rays = rays @ camera.rotation
    image, nearest = np.zeros((*rows.shape, 3)), np.full(rows.shape, np.inf)
    for axis in range(3):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -camera.center[axis] / rays[..., axis]
        hit = (distance > 0) & (distance < nearest)
        others = [other for other in range(3) if other != axis]
        points = camera.center[others] + np.where(hit, distance, 0.0)[..., None] * rays[..., others]
        cell = np.floor(points * (_CELLS / 4)).astype(int) % _CELLS
        image = np.where(hit[..., None], walls[axis][cell[..., 0], cell[..., 1]], image)
        nearest = np.where(hit, distance, nearest)
    blocks = image.reshape(camera.height, samples, camera.width, samples, 3).mean(axis=(1, 3))
    return np.rint(blocks).astype(np.uint8)


def room_cameras(count: int, *, width: int = SIZE, height: int = SIZE, focal: float = FOCAL) -> list[Camera]:
    """Return level cameras on an arc in front of the corner, at varying heights and distances, that look at it."""
    cameras = []
    for i, angle in enumerate(np.radians(np.linspace(15, 75, count))):
        radius, rise = 3.0 + 0.35 * np.sin(2.1 * i), 1.2 + 0.45 * np.sin(1.3 * i)
        eye = np.array([radius * np.cos(angle), radius * np.sin(angle), rise])
        target = np.array([0.3, 0.3, 0.7]) + 0.1 * np.sin([1.7 * i, 2.3 * i, 3.1 * i])
        cameras.append(look_at(eye, target, UP, width=width, height=height, fx=focal))
    return cameras


def write_room(folder: Path, count: int = 12, *, seed: int = 0, suffix: str = ".jpg", start: int = 0) -> list[Camera]:
    """Write the images ``000.jpg`` ...; return their true cameras."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras, walls = room_cameras(count), textures(seed)
    for i, camera in enumerate(cameras):
        Image.fromarray(room_image(camera, walls)).save(folder / f"{start + i:03}{suffix}", quality=95)
    return cameras


def write_walk(folder: Path, count: int = 8) -> None:
    """Write the images of a walk along a wall, looking ahead: no two cameras are side by side."""
    folder.mkdir(parents=True, exist_ok=True)
    walls = textures()
    for i, far in enumerate(np.linspace(3.9, 3.0, count)):
        eye = np.array([0.55, far, 0.5])
        camera = look_at(eye, eye - np.array([0.0, 1.0, 0.0]), UP, width=SIZE, height=SIZE, fx=0.75 * SIZE)
        Image.fromarray(room_image(camera, walls)).save(folder / f"{i:03}.jpg", quality=95)


def turn_file(path: Path, orientation: int) -> None:
    """Store an image as a rotated camera stores it: rotated, with the EXIF orientation that rotates it back."""
    with Image.open(path) as file:
        stored = file.transpose(STORED[orientation])
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    stored.save(path, exif=exif, quality=95)


@dataclass(frozen=True)
class Room:
    """Images, the capture made of them, the command's output, and the true cameras by name."""

    photos: Path
    capture: Path
    printed: dict[str, Any]
    cameras: dict[str, Camera]


def found_room(root: Path) -> Room:
    """Run `gs2d poses` on twelve images, three stored rotated, and one file that is not an image."""
    cameras = write_room(root / "photos", 12)
    for i, orientation in ((2, 6), (5, 8), (9, 3)):
        turn_file(root / "photos" / f"{i:03}.jpg", orientation)
    (root / "photos" / "notes.txt").write_text("corner, noon")
    out = root / "captures" / "room"  # the command also creates the parent folder
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert run(["poses", str(root / "photos"), "--out", str(out), "--json", "--threads", "2"]) == 0
    names = {f"{i:03}.jpg": camera for i, camera in enumerate(cameras)}
    return Room(root / "photos", out, json.loads(printed.getvalue()), names)
