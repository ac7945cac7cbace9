"""Photographs as training wants them, on the disk: undistorted and shrunk once, so that none has to stay in memory.

A file for each photograph, which says what it was made of and holds a checksum: a cache that was broken off is gone on
with, a photograph that changed is prepared again, and a damaged file is as none. Pictures are PNG: no bit is lost.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from gs2d.core.files import disk_error
from gs2d.core.growth import check_growth
from gs2d.core.memory import trim
from gs2d.data.build import Decoder
from gs2d.data.cache import DecodedImage, ImageCache
from gs2d.data.scene import Scene, View
from gs2d.data.undistort import source_positions
from gs2d.errors import DataError

FORMAT = 1
SUFFIX = ".prepared"
AHEAD = 8  # pictures that training asks for before it needs them
_MAGIC = b"gs2d prepared photograph\n"
_PARTS = ("image", "mask", "object_mask", "valid")
_OF_PILLOW = (SyntaxError, RecursionError, OverflowError, Image.DecompressionBombError, MemoryError)
_LEVEL = 1  # of zlib: higher ones take three times as long for a tenth


@dataclass(frozen=True, slots=True)
class Stored:
    """Reads one prepared picture; makes it anew where its file is gone or damaged since.

    Attributes
    ----------
    folder : Path
    key : str
        Of what it was made of.
    original : callable
        Makes the picture from the photograph.
    """

    folder: Path  # of all: a path for each photograph would be 500 bytes more
    key: str
    original: Callable[[], DecodedImage]

    @property
    def file(self) -> Path:
        """Where the picture lies."""
        return file_of(self.folder, self.key)

    def __call__(self) -> DecodedImage:
        """Return the picture."""
        found = read_prepared(self.file, self.key)
        return self.original() if found is None else found


def key_of(view: View) -> str | None:
    """Return a hash of all that decides the picture of a view; None where that is not known (readers from elsewhere).

    Files are known by their size and time, which a file that is written again does not keep.
    """
    if not isinstance(view.decode, Decoder):
        return None
    frame = view.decode.frame
    facts: list[object] = [FORMAT, view.decode.downscale, repr(frame.intrinsics), frame.alpha_is_silhouette]
    if frame.face is not None:
        facts.append(repr(frame.face))
    if frame.mask_is_alpha:
        facts.append("mask is alpha, not the silhouette" if frame.alpha_is_silhouette else "mask is alpha")
    for path in (frame.path, frame.mask, frame.object_mask):
        if path is None:
            facts.append(None)
            continue
        try:
            stat = path.stat()
        except OSError as error:
            raise DataError(f"image {path} cannot be read: {error.strerror or error}") from error
        facts.append([str(path.resolve()), stat.st_size, stat.st_mtime_ns])
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def file_of(folder: Path, key: str) -> Path:
    """Return where the picture of a key lies."""
    return folder / f"{key[:32]}{SUFFIX}"


def write_prepared(file: Path, key: str, picture: DecodedImage) -> int:
    """Write a picture; its file appears when it is whole. Returns its bytes."""
    parts: list[tuple[str, bytes]] = []
    for name in _PARTS:
        array: np.ndarray | None = getattr(picture, name)
        if array is None:
            continue
        if name == "valid" and picture.mask is not None and np.array_equal(array, picture.mask):
            parts.append((name, b""))  # as the mask
            continue
        packed = io.BytesIO()
        Image.fromarray(array).save(packed, format="PNG", compress_level=_LEVEL)
        parts.append((name, packed.getvalue()))
    payload = b"".join(data for _, data in parts)
    sizes = [[name, len(data)] for name, data in parts]
    header = {"key": key, "parts": sizes, "sha256": hashlib.sha256(payload).hexdigest()}
    temporary = file.with_name(f".{file.name}.{os.getpid()}.gs2d.tmp")
    try:
        # Without fsync: after a power cut the checksum says that it is not whole.
        temporary.write_bytes(_MAGIC + json.dumps(header).encode() + b"\n" + payload)
        os.replace(temporary, file)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise disk_error(file, error) from error
    return len(payload)


def read_prepared(file: Path, key: str) -> DecodedImage | None:
    """Return the picture of a file; None where it is not there, of something else, or damaged."""
    try:
        data = file.read_bytes()
    except OSError:
        return None
    end = data.find(b"\n", len(_MAGIC))
    if not data.startswith(_MAGIC) or end < 0:
        return None
    try:
        header = json.loads(data[len(_MAGIC) : end])
        payload = memoryview(data)[end + 1 :]
        if header["key"] != key or header["sha256"] != hashlib.sha256(payload).hexdigest():
            return None
        parts: dict[str, np.ndarray] = {}
        start = 0
        for name, size in header["parts"]:
            packed = payload[start : start + size]
            parts[name] = _unpacked(file, packed, parts.get("image")) if size else parts["mask"]
            start += size
        return _whole(DecodedImage(**parts))
    except (LookupError, TypeError, ValueError, OSError, DataError, *_OF_PILLOW):
        return None


def _unpacked(file: Path, packed: memoryview, image: np.ndarray | None) -> np.ndarray:
    """Return the picture in some bytes, if they can hold one so large; masks, which they can, are as large as that."""
    with Image.open(io.BytesIO(packed), formats=["PNG"]) as picture:
        if image is None:
            check_growth(file, len(packed), 4 * picture.width * picture.height, "a picture")
        elif (picture.height, picture.width) != image.shape[:2]:
            raise ValueError("no mask of the image")
        return np.array(picture)


def _whole(found: DecodedImage) -> DecodedImage:
    """Return a picture as training wants it, or raise ValueError."""
    masks = [mask for mask in (found.mask, found.object_mask, found.valid) if mask is not None]
    height, width, channels = found.image.shape
    if found.image.dtype != np.uint8 or channels not in (3, 4):
        raise ValueError("no image")
    if any(mask.dtype != bool or mask.shape != (height, width) for mask in masks):  # an entry that is the mask
        raise ValueError("no mask of the image")
    return found


def is_prepared(file: Path, key: str) -> bool:
    """Whether a file begins as one of this key; its checksum is looked at when it is read."""
    try:
        with file.open("rb") as opened:
            beginning = opened.read(len(_MAGIC) + 200)
    except OSError:
        return False
    return beginning.startswith(_MAGIC) and key.encode() in beginning


def prepared_scene(scene: Scene, folder: Path) -> Scene:
    """Return the scene with the pictures of a folder where it has them; a few stay in memory, those read last.

    Nothing is written: ``prepare`` does. Views of readers from elsewhere stay as they are.
    """
    pictures = [_bytes(view) for view in scene.views]
    cache = ImageCache(2 * (AHEAD + 1) * max(pictures, default=0))

    def stored(view: View) -> View:
        key = key_of(view)
        if key is None:
            return view
        return replace(view, decode=Stored(folder, key, view.decode), cache=cache)

    train, test = (tuple(stored(view) for view in views) for views in (scene.train, scene.test))
    return replace(scene, train=train, test=test, ahead=AHEAD)


def _bytes(view: View) -> int:
    """Bytes of a decoded picture, at most: four channels and three masks."""
    return view.camera.width * view.camera.height * 7


def decoded_bytes(scene: Scene) -> int:
    """Bytes of all pictures of a scene in memory: three channels; alpha and masks are few."""
    return sum(view.camera.width * view.camera.height * 3 for view in scene.views)


def missing_views(scene: Scene) -> list[View]:
    """Return the views of a ``prepared_scene`` that have no file yet, in order."""
    return [
        view
        for view in scene.views
        if isinstance(view.decode, Stored) and not is_prepared(view.decode.file, view.decode.key)
    ]


def prepare_here(views: Sequence[View], threads: int) -> Iterator[int]:
    """Prepare views of a ``prepared_scene`` on threads of this process; yields the bytes of each file.

    Raises
    ------
    DataError
        A photograph that does not decode.
    DiskError
    """

    def write(view: View) -> int:
        assert isinstance(view.decode, Stored)
        return write_prepared(view.decode.file, view.decode.key, view.decode.original())

    with ThreadPoolExecutor(max_workers=max(1, threads)) as pool:
        try:
            yield from pool.map(write, views)
        finally:
            pool.shutdown(cancel_futures=True)
            trim()


def forget_others(scene: Scene, folder: Path) -> None:
    """Delete files of a folder that no view of a ``prepared_scene`` is of, and what was left half-written."""
    wanted = {view.decode.file.name for view in scene.views if isinstance(view.decode, Stored)}
    for file in folder.iterdir():
        if file.name not in wanted and (file.suffix == SUFFIX or file.name.endswith(".gs2d.tmp")):
            with contextlib.suppress(OSError):
                file.unlink()


@dataclass(frozen=True)
class Task:
    """A picture that another process prepares."""

    decoder: Decoder
    file: Path
    key: str

    def __getstate__(self) -> tuple[object, ...]:
        return (self.decoder.frame, self.decoder.downscale, self.file, self.key)

    def __setstate__(self, state: tuple[object, ...]) -> None:
        frame, downscale, file, key = state
        object.__setattr__(self, "decoder", Decoder(frame, downscale, _lens_maps))  # type: ignore[arg-type]
        object.__setattr__(self, "file", file)
        object.__setattr__(self, "key", key)

    def write(self) -> int:
        """Prepare it; returns the bytes of its file."""
        return write_prepared(self.file, self.key, self.decoder())


_lens_maps = functools.lru_cache(maxsize=4)(source_positions)  # of this process
