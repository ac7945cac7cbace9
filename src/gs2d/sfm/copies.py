"""Copy photographs and their masks into the capture, upright and downscaled. The originals are only read."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from gs2d.core.atomic_files import atomic_write
from gs2d.data.exif import DAMAGED_EXIF
from gs2d.data.file_names import in_any_case
from gs2d.data.image_files import image_size, open_image, read_image, read_mask, write_image
from gs2d.data.masks import FOLDER, Masks, find_masks, find_masks_in
from gs2d.errors import DataError
from gs2d.io.run_dir import make_folder
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
        make_folder(parent)
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
    metadata = _metadata(photo.source)
    with atomic_write(target) as out:
        if target.suffix.lower() in JPEG:
            image.save(out, "JPEG", quality=QUALITY, subsampling=0, **metadata)
        else:
            image.save(out, "PNG", **metadata)


def _metadata(source: Path) -> dict[str, bytes]:
    """Return the colour profile (of RGB images only) and EXIF block of an image, for Pillow's ``save``."""
    with open_image(source) as file:
        profile = file.info.get("icc_profile") if file.mode in ("RGB", "RGBA") else None
        metadata = {"icc_profile": profile} if profile else {}
        with contextlib.suppress(*DAMAGED_EXIF):
            exif = file.getexif()
            exif.pop(ExifTags.Base.Orientation, None)
            metadata["exif"] = exif.tobytes()
    return metadata


# -- masks -------------------------------------------------------------------------------------------------------------
_ASPECT = 0.01  # largest relative difference of the aspect ratios of a mask and its photograph


def masks_of(photos: Sequence[Photo], root: Path, folder: Path | None) -> tuple[list[Path | None], str]:
    """Return the mask of each photograph or None, and a message about them ("" if there are none).

    ``root``: folder of the photographs. Masks are searched in ``masks`` inside or beside it or in its sub-folders, and
    as ``STEM_mask.png`` or ``NAME.mask.png``. ``folder``: folder of the masks (``--masks``), instead of the search.
    Raises DataError if ``folder`` does not exist or has no mask of these photographs.
    """
    if folder is not None and not folder.is_dir():
        raise DataError(f"--masks must be a folder of masks, got {folder}, which does not exist")
    names, images = [photo.label for photo in photos], [photo.source for photo in photos]
    own: dict[Path, Path | None] = {}
    for parent in dict.fromkeys(image.parent for image in images) if folder is None else ():
        inside = [image for image in images if image.parent == parent]
        own.update(
            zip(inside, find_masks_in([in_any_case(parent, FOLDER)], [image.name for image in inside]), strict=True)
        )
    return find_masks(names, images, [own.get(image) for image in images], [root, root.resolve().parent], Masks(folder))


def copy_masks(photos: Sequence[Photo], masks: Sequence[Path | None], folder: Path, max_size: int | None) -> int:
    """Write masks as ``folder/NAME.png`` with the size of the copied images; returns their number.

    Raises DataError if a mask and its photograph differ in shape, or all masks are completely black.
    """
    count, has_white = 0, False
    for photo, path in zip(photos, masks, strict=True):
        if path is None:
            continue
        target = folder / f"{photo.name}.png"
        if target.exists():  # from an interrupted search
            count, has_white = count + 1, True
            continue
        make_folder(target.parent)
        mask = _resized(_upright(photo, path), photo.size_within(max_size))
        write_image(target, mask)
        count, has_white = count + 1, has_white or bool(mask.any())
    if count == len(photos) and not has_white:
        raise DataError(f"masks must have white pixels (white = keep), got {count} completely black ones; invert them")
    return count


def _resized(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize a mask, bool [H, W], to (width, height); a pixel is True if all of its area is."""
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    grey = Image.fromarray(mask.astype(np.uint8) * np.uint8(255)).resize(size, Image.Resampling.BOX)
    return np.asarray(grey) == 255


def _upright(photo: Photo, path: Path) -> np.ndarray:
    """Read a mask, bool [H, W], rotated like its upright photograph.

    Raises DataError if its shape differs from that of the photograph.
    """
    width, height = photo.size
    stored = (height, width) if photo.orientation >= 5 else (width, height)
    size = image_size(path)
    if _alike(size, stored):  # masks are assumed to match the stored pixels: a rotation by 180 degrees is ambiguous
        mask = Image.fromarray(read_mask(path).astype(np.uint8))
        return np.asarray(turn(mask, photo.orientation)) > 0
    if _alike(size, photo.size):  # written by a program that rotates photographs upright
        return read_mask(path)
    raise DataError(
        f"mask {path} must have the size or aspect ratio of {photo.label}, {stored[0]}x{stored[1]}, got "
        f"{size[0]}x{size[1]}; create it from the same file"
    )


def _alike(a: tuple[int, int], b: tuple[int, int]) -> bool:
    ratio = (a[0] / a[1]) / (b[0] / b[1])
    return abs(ratio - 1) <= max(_ASPECT, 1 / min(a), 1 / min(b))
