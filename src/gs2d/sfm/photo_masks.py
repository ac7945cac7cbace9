"""Masks of photographs without cameras: found where tools put them, and copied into the capture as COLMAP names them.

They are turned and shrunk with their photographs. COLMAP then looks for no features in their black pixels, and training
finds them in the capture as those of any other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
from PIL import Image

from gs2d.core.files import disk_error
from gs2d.data.file_names import in_any_case
from gs2d.data.image_files import image_size, read_mask, write_image
from gs2d.data.masks import FOLDER, Masks, find_masks, find_masks_in
from gs2d.errors import DataError
from gs2d.sfm.fisheye import Circle
from gs2d.sfm.photos import Photo, turn

_NONE: Mapping[str, Circle] = MappingProxyType({})
_ASPECT = 0.01  # by which a mask of another size may differ from its photograph


def masks_of(photos: Sequence[Photo], root: Path, folder: Path | None) -> tuple[list[Path | None], str]:
    """Return the mask of each photograph, and a line about them ("" without any).

    Parameters
    ----------
    photos : sequence of Photo
    root : Path
        Folder of the photographs: masks are in ``masks`` in it, beside it or in its sub-folders, or are called
        ``STEM_mask.png`` or ``NAME.mask.png``.
    folder : Path or None
        Where they are instead, as the user says.

    Raises
    ------
    DataError
        The user's folder is none, or holds no mask of these photographs.
    """
    if folder is not None and not folder.is_dir():
        raise DataError(f"--masks must be a folder of masks, got {folder}, which is none")
    names, images = [photo.label for photo in photos], [photo.source for photo in photos]
    own: dict[Path, Path | None] = {}
    for parent in dict.fromkeys(image.parent for image in images) if folder is None else ():
        inside = [image for image in images if image.parent == parent]
        own.update(
            zip(inside, find_masks_in([in_any_case(parent, FOLDER)], [image.name for image in inside]), strict=True)
        )
    return find_masks(names, images, [own.get(image) for image in images], [root, root.resolve().parent], Masks(folder))


def copy_masks(
    photos: Sequence[Photo],
    masks: Sequence[Path | None],
    folder: Path,
    max_size: int | None,
    circles: Mapping[str, Circle] = _NONE,
) -> int:
    """Write the masks of photographs as ``folder/NAME.png``, in the size of their copies; how many there are.

    Parameters
    ----------
    circles : dict of str to Circle
        Of round photographs, by name: what is beyond is masked too.

    Raises
    ------
    DataError
        A mask of another shape than its photograph, or without a white pixel in all of them.
    DiskError
    """
    count, kept = 0, False
    for photo, path in zip(photos, masks, strict=True):
        circle = circles.get(photo.name)
        if path is None and circle is None:
            continue
        target = folder / f"{photo.name}.png"
        if target.exists():  # of a search that was interrupted
            count, kept = count + 1, True
            continue
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise disk_error(target.parent, error) from error
        size = photo.size_within(max_size)
        mask = np.ones(size[::-1], bool) if path is None else _resized(_upright(photo, path), size)
        if circle is not None:
            mask = mask & circle.inside(*size)
        write_image(target, mask)
        count, kept = count + 1, kept or bool(mask.any())
    if count == len(photos) and not kept:
        raise DataError(
            f"masks must keep a pixel of some photograph, got {count} black ones; white = keep: invert them"
        )
    return count


def _resized(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a mask bool [H, W] in another size (width, height): True where all of a pixel is."""
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    grey = Image.fromarray(mask.astype(np.uint8) * np.uint8(255)).resize(size, Image.Resampling.BOX)
    return np.asarray(grey) == 255


def _upright(photo: Photo, path: Path) -> np.ndarray:
    """Return a mask as its photograph is seen, bool [H, W]; one of the stored pixels' shape is turned with them.

    Raises
    ------
    DataError
        It has another shape.
    """
    width, height = photo.size
    stored = (height, width) if photo.orientation >= 5 else (width, height)
    size = image_size(path)
    if _alike(size, stored):  # a half turn cannot be told from none: masks are of the file's pixels
        mask = Image.fromarray(read_mask(path).astype(np.uint8))
        return np.asarray(turn(mask, photo.orientation)) > 0
    if _alike(size, photo.size):  # made by a program that had turned the photograph
        return read_mask(path)
    raise DataError(
        f"mask {path} must have the size (or aspect) of {photo.label}, {stored[0]}x{stored[1]}, got "
        f"{size[0]}x{size[1]}; make it of the same file"
    )


def _alike(a: tuple[int, int], b: tuple[int, int]) -> bool:
    ratio = (a[0] / a[1]) / (b[0] / b[1])
    return abs(ratio - 1) <= max(_ASPECT, 1 / min(a), 1 / min(b))
