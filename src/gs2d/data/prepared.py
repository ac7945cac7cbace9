"""Prepared images: undistorted and downscaled once, stored on disk, so that they need not stay in memory.

Each file is a ZIP archive of PNG images, which are lossless. Its name is a hash of everything that determines the
image: an interrupted preparation continues, a changed photograph is prepared again. A damaged file fails its checksum
and is ignored.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from gs2d.core.atomic_files import atomic_write
from gs2d.core.memory import trim
from gs2d.core.memory_limit import cache_bytes
from gs2d.data.build import Decoder
from gs2d.data.cache import DecodedImage, ImageCache
from gs2d.data.scene import Scene, View
from gs2d.errors import DataError, DiskError

FORMAT = 2
SUFFIX = ".prepared"
AHEAD = 8  # images that training requests in advance
PIXEL_BYTES = 60  # memory per pixel of a photograph while it is undistorted
PACKED_RATIO = 0.7  # largest expected size of a prepared file, relative to its RGB pixels: measured 0.3 to 0.65
_PARTS = ("image", "mask", "object_mask", "valid")
_DAMAGED = (
    *(OSError, LookupError, TypeError, ValueError, SyntaxError, RecursionError, OverflowError, MemoryError),
    *(zipfile.BadZipFile, NotImplementedError, EOFError, Image.DecompressionBombError),
)
_LEVEL = 1  # of zlib: higher levels take three times as long and save a tenth


@dataclass(frozen=True, slots=True)
class Stored:
    """Reads one prepared image; decodes the photograph if the file is missing or damaged.

    Attributes
    ----------
    folder : Path
        Shared by all images: a path per image would take 500 bytes more.
    key : str
        Hash of everything that determines the image.
    original : callable
        Decodes the photograph.
    """

    folder: Path
    key: str
    original: Callable[[], DecodedImage]

    @property
    def file(self) -> Path:
        """Path of the prepared image."""
        return self.folder / f"{self.key}{SUFFIX}"

    def __call__(self) -> DecodedImage:
        """Return the image."""
        stored = read_prepared(self.file)
        return self.original() if stored is None else stored


def _key_of(view: View) -> str | None:
    """Return a hash of everything that determines the image of a view; None for views of third-party readers.

    Files are identified by path, size and modification time.
    """
    if not isinstance(view.decode, Decoder):
        return None
    frame = view.decode.frame
    facts: list[object] = [FORMAT, view.decode.downscale, repr(frame.intrinsics), repr(frame.face)]
    facts += [frame.alpha_is_silhouette, frame.mask_is_alpha]
    for path in (frame.path, frame.mask, frame.object_mask):
        if path is None:
            facts.append(None)
            continue
        try:
            stat = path.stat()
        except OSError as error:
            raise DataError(f"image {path} cannot be read: {error.strerror or error}") from error
        facts.append([str(path.resolve()), stat.st_size, stat.st_mtime_ns])
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:32]


def write_prepared(file: Path, image: DecodedImage) -> None:
    """Write an image and its masks atomically."""
    with atomic_write(file) as target, zipfile.ZipFile(target, "w") as archive:
        for name in _PARTS:
            array: np.ndarray | None = getattr(image, name)
            if array is None:
                continue
            packed = io.BytesIO()
            Image.fromarray(array).save(packed, format="PNG", compress_level=_LEVEL)
            archive.writestr(zipfile.ZipInfo(name), packed.getvalue())


def read_prepared(file: Path) -> DecodedImage | None:
    """Read an image and its masks; None if the file is missing or damaged."""
    try:
        with zipfile.ZipFile(file) as archive:
            names = archive.namelist()
            parts = {name: archive.read(name) for name in _PARTS if name in names}  # checks the CRC
        arrays = {name: np.array(Image.open(io.BytesIO(data), formats=["PNG"])) for name, data in parts.items()}
        image = DecodedImage(**arrays)
    except _DAMAGED:
        return None
    masks = [mask for mask in (image.mask, image.object_mask, image.valid) if mask is not None]
    valid = image.image.dtype == np.uint8 and image.image.ndim == 3 and image.image.shape[2] in (3, 4)
    return image if valid and all(m.dtype == bool and m.shape == image.image.shape[:2] for m in masks) else None


def prepared_scene(scene: Scene, folder: Path) -> Scene:
    """Return the scene with views that read the prepared images in a folder; the last few stay in memory.

    Writes nothing. Views of third-party readers are unchanged.
    """
    cache = ImageCache(2 * (AHEAD + 1) * max(map(_most_bytes, scene.views), default=0))

    def stored(view: View) -> View:
        key = _key_of(view)
        return view if key is None else replace(view, decode=Stored(folder, key, view.decode), cache=cache)

    train, test = (tuple(stored(view) for view in views) for views in (scene.train, scene.test))
    return replace(scene, train=train, test=test, ahead=AHEAD)


def _most_bytes(view: View) -> int:
    """Return the largest size of a decoded image: four channels and three masks."""
    return view.camera.width * view.camera.height * 7


def decoded_bytes(scene: Scene) -> int:
    """Return the memory of all decoded images of a scene, with three channels."""
    return sum(view.camera.width * view.camera.height * 3 for view in scene.views)


def packed_bytes(views: Sequence[View]) -> int:
    """Return the disk space of the prepared images of views, as an upper estimate."""
    return int(PACKED_RATIO * 3 * sum(view.camera.width * view.camera.height for view in views))


def missing_views(scene: Scene) -> list[View]:
    """Return the views of a ``prepared_scene`` that have no valid file yet, in order."""
    return [view for view in scene.views if isinstance(view.decode, Stored) and not _is_archive(view.decode.file)]


def _is_archive(file: Path) -> bool:
    try:
        return zipfile.is_zipfile(file)
    except OSError:
        return False


def check_disk(folder: Path, views: Sequence[View]) -> None:
    """Raise DiskError if the prepared images of views do not fit on the disk.

    Parameters
    ----------
    folder : Path
        Target folder; need not exist.
    views : sequence of View
    """
    existing = next(path for path in (folder, *folder.resolve().parents) if path.exists())
    free, need = shutil.disk_usage(existing).free, packed_bytes(views)
    if need > free:
        raise DiskError(
            f"{len(views):,} prepared images need about {need / 2**30:.2g} GiB of disk, got {free / 2**30:.2g} GiB "
            f"free at {existing}; use a larger --downscale, another --out, or --set prepare=never"
        )


def prepare(views: Sequence[View], threads: int) -> Iterator[None]:
    """Write the files of views of a ``prepared_scene``, on threads; yields after each.

    Raises
    ------
    DataError
        If a photograph does not decode.
    DiskError
        If a file cannot be written.
    """

    def write(view: View) -> None:
        assert isinstance(view.decode, Stored)
        write_prepared(view.decode.file, view.decode.original())

    sizes = [view.file_intrinsics() for view in views]
    affordable = cache_bytes(1 << 50) // max((PIXEL_BYTES * k.width * k.height for k in sizes), default=1)
    with ThreadPoolExecutor(max_workers=max(1, min(threads, affordable))) as pool:
        try:
            yield from pool.map(write, views)
        finally:
            pool.shutdown(cancel_futures=True)
            trim()


def delete_unused(scene: Scene, folder: Path) -> None:
    """Delete the files in a folder that belong to no view of a ``prepared_scene``, and unfinished ones."""
    used = {view.decode.file.name for view in scene.views if isinstance(view.decode, Stored)}
    for file in folder.iterdir():
        if file.name not in used and (file.suffix == SUFFIX or file.name.endswith(".gs2d.tmp")):
            with contextlib.suppress(OSError):
                file.unlink()
