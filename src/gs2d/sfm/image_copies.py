"""Copy photographs into the capture: unchanged, or rotated upright and downscaled. The originals are only read."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PIL import ExifTags, Image

from gs2d.core.atomic_files import atomic_write, disk_error
from gs2d.data.exif import DAMAGED_EXIF
from gs2d.data.image_files import open_image, read_image
from gs2d.errors import DataError
from gs2d.sfm.photos import JPEG, Photo, turn

QUALITY = 95  # of re-encoded JPEG files, without chroma subsampling


def copy_images(
    photos: Sequence[Photo], folder: Path, *, max_size: int | None, link: bool, threads: int
) -> Generator[str, None, None]:
    """Copy images into ``folder``; yields "copied", "linked", "turned", "resized" or "converted" for each.

    Files that exist, from an interrupted search, are kept. ``max_size``: largest longer side, px. ``link``: use hard
    links for unchanged images; they are copied if the folder is on another disk.
    """
    for parent in sorted({(folder / photo.name).parent for photo in photos}):
        try:
            parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise disk_error(parent, error) from error
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(lambda photo: _stage(photo, folder / photo.name, max_size, link), photos)


def _stage(photo: Photo, target: Path, max_size: int | None, link: bool) -> str:
    size = photo.size_within(max_size)
    if size == photo.size and photo.orientation == 1 and not photo.is_converted:
        if link:
            with contextlib.suppress(OSError):
                if not target.exists():
                    os.link(photo.source.resolve(), target)
                if os.path.samefile(photo.source, target):
                    return "linked"
        if not target.exists():
            _copy(photo.source, target)
        return "copied"
    if not target.exists():
        _rewrite(photo, target, size)
    if size != photo.size:
        return "resized"
    return "turned" if photo.orientation != 1 else "converted"


def _copy(source: Path, target: Path) -> None:
    try:
        file = open(source, "rb")  # noqa: SIM115 - closed below; its errors must not be reported for the target
    except OSError as error:
        raise DataError(f"cannot read {source}: {error.strerror or error}") from error
    with file, atomic_write(target) as copy:
        shutil.copyfileobj(file, copy, 1 << 20)


def _rewrite(photo: Photo, target: Path, size: tuple[int, int]) -> None:
    """Re-encode an image: upright, with ``size``, as JPEG or PNG. EXIF is kept except for the orientation."""
    image = turn(Image.fromarray(read_image(photo.source)), photo.orientation)
    if image.size != size:
        premultiplied = image.convert("RGBa") if image.mode == "RGBA" else image
        image = premultiplied.resize(size, Image.Resampling.LANCZOS).convert(image.mode)
    kept = _kept(photo.source)
    with atomic_write(target) as out:
        if target.suffix.lower() in JPEG:
            image.save(out, "JPEG", quality=QUALITY, subsampling=0, **kept)
        else:
            image.save(out, "PNG", **kept)


def _kept(source: Path) -> dict[str, bytes]:
    """Return the colour profile (of RGB images only) and EXIF block of an image, for Pillow's ``save``."""
    with open_image(source) as file:
        profile = file.info.get("icc_profile") if file.mode in ("RGB", "RGBA") else None
        kept = {"icc_profile": profile} if profile else {}
        with contextlib.suppress(*DAMAGED_EXIF):
            exif = file.getexif()
            exif.pop(ExifTags.Base.Orientation, None)
            kept["exif"] = exif.tobytes()
    return kept
